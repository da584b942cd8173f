/** What parts that several views use say, in English. */

/** "from -3 to 5 mm", "at least 1", "a number". */
function limits(least: number, most: number, unit: string): string {
  const mm = unit && ` ${unit}`;
  if (Number.isFinite(least) && Number.isFinite(most)) return `a number from ${least} to ${most}${mm}`;
  if (Number.isFinite(least)) return `a number of at least ${least}${mm}`;
  return Number.isFinite(most) ? `a number of at most ${most}${mm}` : "a number";
}

export const shared = {
  slider: {
    value: "value",
    outside: (least: number, most: number, unit: string): string => `This takes ${limits(least, most, unit)}.`,
    reset: (value: number, unit: string): string => `Double click: ${value}${unit && ` ${unit}`}`,
  },
  field: {
    ofList: (label: string, place: number, count: number): string => `${label} ${place} of ${count}`,
  },
  confidence: {
    title: "Confidence",
    later: "It is told with the first frame.",
    unknown: "Not known: the scene does not tell what it was trained from.",
    similarity: "Expected similarity",
    similarityMeans: (good: string, warn: string): string =>
      `To a real image here (MS-SSIM): ${good} and more is well supported, below ${warn} a guess`,
    range: (low: string, high: string): string => `(${low.replace(" %", "")} to ${high})`,
    rangeMeans: (views: number): string => `Mean error on the ${views} views that the figure was fitted on`,
    distance: "To training views",
    support: "Pixels with support",
    supportMeans: "Coverage of at least 0.3",
    unseen: "The training sweep did not show this. Snap, in Scan, goes to the nearest view of it.",
    black: "Black where nothing supports it",
    blackMeans: "Coverage below 0.3 is shown black",
    notThere: "This scene was trained without confidence",
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
