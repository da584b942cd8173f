/** How familiar a view is to the scene, in a word and in figures. */

import type { SceneDescription } from "../api/scenes";
import type { Extrapolation } from "../api/stream";
import { fixed } from "../shared/local";
import { words } from "../words/words.svelte";

export type Tone = "good" | "warn" | "bad";

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

/** The confidence of a frame as a person reads it, on the image and in saved pictures. */
export interface ConfidenceWords {
  tone: Tone;
  /** "A guess" */
  title: string;
  /** "expected similarity 43 %, mean error 8 points"; without a model the way to the training views; then the contact. */
  detail: string;
  /** Why to be careful; empty where the view is well supported. */
  warning: string;
}

/** null: nothing is known, so that nothing should be claimed. */
export function confidenceWords(
  { extrapolation }: { extrapolation: Extrapolation },
  description: SceneDescription | null,
): ConfidenceWords | null {
  const tone = toneOf(extrapolation);
  if (tone === null) return null;
  const said = words.connect.confidence;
  const { confidence, distance_mm, angle_deg, contact_share } = extrapolation;
  const touch = contact_share === null ? "" : `, ${said.contact(percent(contact_share))}`;
  const fit = description?.confidence ?? null;
  const title = said.tones[tone];
  const warning = said.warnings[tone];
  if (confidence === null) {
    const detail = said.away(fixed(distance_mm ?? 0, 1), fixed(angle_deg ?? 0, 1));
    return { tone, title, detail: detail + touch, warning };
  }
  const similarity = percent(confidence);
  const detail = fit === null ? said.expected(similarity) : said.withError(similarity, percent(fit.error));
  return { tone, title, detail: detail + touch, warning };
}

/** A share as a whole number of percent; so are differences of shares as points. */
export function percent(share: number): number {
  return Math.round(share * 100);
}
