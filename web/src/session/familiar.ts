/** How familiar a view is to the scene, in a word. */

import type { Extrapolation } from "../api/stream";

export type Tone = "good" | "warn" | "bad";

export const TITLES: Record<Tone, string> = {
  good: "Well supported",
  warn: "Partly a guess",
  bad: "A guess",
};
/** From which similarity on a view is well supported, and from which it is more than a guess. */
export const EXPECTED = { good: 0.8, warn: 0.6 };
const CLOSE = { mm: 2, deg: 10 };
const FAR = { mm: 6, deg: 25 };

/** By the similarity that is expected; where the scene cannot tell, by the way to its training views. null: unknown. */
export function toneOf({ confidence, distance_mm, angle_deg }: Extrapolation): Tone | null {
  if (confidence !== null) {
    if (confidence >= EXPECTED.good) return "good";
    return confidence >= EXPECTED.warn ? "warn" : "bad";
  }
  if (distance_mm === null || angle_deg === null) return null;
  if (distance_mm <= CLOSE.mm && angle_deg <= CLOSE.deg) return "good";
  return distance_mm <= FAR.mm && angle_deg <= FAR.deg ? "warn" : "bad";
}
