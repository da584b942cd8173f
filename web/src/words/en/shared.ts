/** What parts that several views use say, in English. */

/** "from -3 to 5 mm", "at least 1", "a number". */
function limits(least: number, most: number, unit: string): string {
  const mm = unit && ` ${unit}`;
  if (Number.isFinite(least) && Number.isFinite(most)) return `a number from ${least} to ${most}${mm}`;
  if (Number.isFinite(least)) return `a number of at least ${least}${mm}`;
  return Number.isFinite(most) ? `a number of at most ${most}${mm}` : "a number";
}

/** Of fields whose own names are not plain words; others are called as the service calls them. */
const labels: Record<string, string | undefined> = {
  below_min_confidence: "Below that",
  contact: "Off the skin",
  dtype: "Numbers as",
  height: "Depth samples",
  min_confidence: "Least confidence",
  reverberation: "Comet tail",
  shard_frames: "Frames in a file",
  width: "Scan lines",
};

export const shared = {
  chart: (title: string, unit: string, x: string, series: string[]): string =>
    `${title}${unit && ` in ${unit}`} over ${x}: ${series.join(", ")}`,
  nameValue: (line: string): string => `"${line}" must be written as name = value.`,
  metrics: "Metrics",
  better: (higher: boolean): string => (higher ? "higher is better" : "lower is better"),
  slider: {
    value: "value",
    outside: (least: number, most: number, unit: string): string => `This takes ${limits(least, most, unit)}.`,
    reset: (value: number, unit: string): string => `Double click: ${value}${unit && ` ${unit}`}`,
  },
  field: {
    ofList: (label: string, place: number, count: number): string => `${label} ${place} of ${count}`,
    labels,
  },
  only: (who: string, what: string): string => `Only ${who} may ${what}.`,
  keep: "Keep",
  fetching: "Fetching …",
  loading: "Loading",
  you: "you",
  private: "private",
  privateTo: (owner: string | null): string => `Only ${owner === null ? "" : `${owner} and `}admins see it`,
  privateChoice: "Private",
  privateMeans: "only you and admins see it",
};
