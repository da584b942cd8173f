/** How far a view can be trusted: in words and figures, along a sweep, and as pixels that lie over the image. */

import type { Output } from "../api/contract";
import { assessPoses, type Extrapolation } from "../api/rendering";
import type { SceneDescription } from "../api/scenes";
import type { Frame } from "../api/stream";
import { between } from "../geometry/pose";
import { service } from "../page/service.svelte";
import { fixed } from "../shared/text";
import { words } from "../words/words.svelte";
import { besideSession, type Session } from "./session.svelte";

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

const SUPPORTED = 0.3 * 255; // coverage below which the service counts a pixel as not supported
const LINES = 44; // across the image
const MOST_PIXELS = 320; // of a layer, on its longer side
const HATCH = rgba(150, 205, 235, 0.42);
/** Standard deviation, in grey levels of 0 to 1, that gets the full colour. */
export const MOST_UNCERTAIN = 0.25;
const COLOURS = Uint32Array.from({ length: 256 }, (_, value) => uncertainColour(value / 255 / MOST_UNCERTAIN));

/** Pixels that lie over those of a frame; of a large frame fewer, so that drawing them costs no frames. */
export interface Layer {
  width: number;
  height: number;
  /** Pixels of the frame from one to the next. */
  step: number;
}

export function layerOver({ width, height }: { width: number; height: number }): Layer {
  const step = Math.ceil(Math.max(width, height) / MOST_PIXELS);
  return { width: Math.ceil(width / step), height: Math.ceil(height / step), step };
}

/** Draws diagonal lines where the coverage is low; `width`: of the frame. */
export function hatched(pixels: Uint32Array, layer: Layer, coverage: Uint8Array, width: number): void {
  const period = Math.max(5, Math.round(layer.width / LINES));
  const thick = Math.max(1, Math.round(period / 5));
  overEach(layer, width, (at, of, diagonal) => {
    if (diagonal % period < thick && coverage[of]! < SUPPORTED) pixels[at] = HATCH;
  });
}

/** Colours pixels by the error that they are expected to have. */
export function uncertain(pixels: Uint32Array, layer: Layer, deviation: Uint8Array, width: number): void {
  overEach(layer, width, (at, of) => (pixels[at] = COLOURS[deviation[of]!]!));
}

/** Goes over the pixels of a layer; `of`: the pixel of the frame that each lies over. */
function overEach({ width: columns, height, step }: Layer, width: number, put: (at: number, of: number, diagonal: number) => void): void {
  for (let row = 0; row < height; row++)
    for (let column = 0; column < columns; column++) put(row * columns + column, (row * width + column) * step, column + row);
}

/** From nothing over yellow to magenta, as CSS for the scale. */
export function uncertaintyScale(): string {
  const stops = [0, 0.25, 0.5, 0.75, 1].map((share) => {
    const [red, green, blue, alpha] = shades(share);
    return `rgba(${red}, ${green}, ${blue}, ${alpha})`;
  });
  return `linear-gradient(to right, ${stops.join(", ")})`;
}

function uncertainColour(share: number): number {
  const [red, green, blue, alpha] = shades(Math.min(1, share));
  return rgba(red, green, blue, alpha);
}

function shades(share: number): [number, number, number, number] {
  return [255, Math.round(205 - 165 * share), Math.round(40 + 130 * share), Number((0.75 * share).toFixed(3))];
}

function rgba(red: number, green: number, blue: number, alpha: number): number {
  return ((Math.round(alpha * 255) << 24) | (blue << 16) | (green << 8) | red) >>> 0;
}

const NEARLY_ALL = 0.995; // of the pixels with support: there is nothing to hatch

/** What is drawn over the image of a session, and which outputs that takes. */
export class Overlays {
  /** Hatches what no Gaussians support, of views that are guesses: in a view of the sweep, that is black tissue or shadow. */
  hatch = $state(true);
  uncertainty = $state(false);
  /** Times and losses of frames. */
  latency = $state(false);
  #hasGaps = $state(false);

  constructor(private readonly session: Session) {}

  get knowsUncertainty(): boolean {
    return this.session.scene.description?.outputs.includes("uncertainty") ?? false;
  }

  /** What must come beside the image: coverage only while there is something to hatch. */
  get outputs(): Output[] {
    const wanted: Output[] = [];
    if (this.hatch && this.#hasGaps) wanted.push("coverage");
    if (this.uncertainty && this.knowsUncertainty) wanted.push("uncertainty");
    return wanted;
  }

  /** Takes note of a frame that was shown. */
  shown(frame: Frame): void {
    this.#hasGaps = hasGaps(frame);
  }
}

/** Whether a frame is a guess that lacks support somewhere. */
export function hasGaps({ header: { extrapolation } }: Frame): boolean {
  return toneOf(extrapolation) !== "good" && (extrapolation.supported_share ?? 1) < NEARLY_ALL;
}

/** Those of a session; the same for every view. */
export const overlaysOf = besideSession((session) => new Overlays(session));

const MOST_PLACES = 160;
const MOST_BETWEEN = 4; // places from one pose to the next
const SETTLED_MS = 250; // after the last change of what is played

/** How far the image along the poses that are played can be trusted: asked for once, without rendering. */
export class SweepConfidence {
  /** At even distances from the first pose to the last; empty until it is known. */
  along = $state.raw<Extrapolation[]>([]);

  /** Must be made while a component is being made. */
  constructor(session: Session) {
    $effect(() => {
      const { track, chosenProbe, scene } = session;
      if (!scene.known || track.length < 2 || service.status !== "ready") return;
      const count = Math.min(MOST_PLACES, (track.length - 1) * MOST_BETWEEN + 1);
      const poses = Array.from({ length: count }, (_, index) => {
        const place = (index / (count - 1)) * (track.length - 1);
        const before = Math.floor(place);
        return session.held(between(track[before]!, track[Math.min(before + 1, track.length - 1)]!, place - before));
      });
      let gone = false;
      const timer = setTimeout(() => {
        assessPoses(session.name, poses, chosenProbe).then(
          (found) => {
            if (!gone) this.along = found;
          },
          () => undefined, // the slider does without it
        );
      }, SETTLED_MS);
      return () => {
        gone = true;
        clearTimeout(timer);
        this.along = [];
      };
    });
  }
}
