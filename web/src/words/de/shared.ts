/** What parts that several views use say, in German. */

import type { Words } from "../en/english";

function limits(least: number, most: number, unit: string): string {
  const mm = unit && ` ${unit}`;
  if (Number.isFinite(least) && Number.isFinite(most)) return `eine Zahl von ${least} bis ${most}${mm}`;
  if (Number.isFinite(least)) return `eine Zahl ab ${least}${mm}`;
  return Number.isFinite(most) ? `eine Zahl bis ${most}${mm}` : "eine Zahl";
}

export const shared: Words["shared"] = {
  chart: (title, unit, x, series) => `${title}${unit && ` in ${unit}`} über ${x}: ${series.join(", ")}`,
  nameValue: (line) => `„${line}“ muss als Name = Wert geschrieben sein.`,
  metrics: "Maße",
  better: (higher: boolean): string => (higher ? "höher ist besser" : "niedriger ist besser"),
  slider: {
    value: "Wert",
    outside: (least, most, unit) => `Hier passt nur ${limits(least, most, unit)}.`,
    reset: (value, unit) => `Doppelklick: ${value}${unit && ` ${unit}`}`,
  },
  field: {
    ofList: (label, place, count) => `${label} ${place} von ${count}`,
  },
  only: (who, what) => `Nur ${who} dürfen ${what}.`,
  keep: "Behalten",
  fetching: "Wird geholt …",
  loading: "Lädt",
  you: "Sie",
  private: "privat",
  privateTo: (owner) => `Nur ${owner === null ? "" : `${owner} und `}Verwalter sehen das`,
  privateChoice: "Privat",
  privateMeans: "nur Sie und Verwalter sehen es",
};
