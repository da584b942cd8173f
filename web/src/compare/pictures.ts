/** Pictures as numbers, what two of them make together, and what the metrics of many frames say. */

import { request } from "../api/client";
import type { ComparedFrame, Metric } from "../api/scenes";
import { type Colour, ramp } from "../shared/colours";
import { LABELS } from "../shared/text";

export interface Grey {
  width: number;
  height: number;
  /** Row by row, 0 to 255. */
  values: Uint8Array;
}

/** A picture of the service. Throws ServiceError, Unreachable. */
export async function readGrey(path: string, signal: AbortSignal): Promise<Grey> {
  const bitmap = await createImageBitmap(await (await request(path, { signal })).blob());
  const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (context === null) throw new Error("The browser cannot read pictures.");
  context.drawImage(bitmap, 0, 0);
  const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
  const values = new Uint8Array(bitmap.width * bitmap.height);
  for (let index = 0; index < values.length; index++) values[index] = data[4 * index]!;
  bitmap.close();
  return { width: canvas.width, height: canvas.height, values };
}

/** The value at shares of width and height, 0 to 1; null beside the picture. */
export function valueAt({ width, height, values }: Grey, u: number, v: number): number | null {
  if (u < 0 || v < 0 || u >= 1 || v >= 1) return null;
  return values[Math.floor(v * height) * width + Math.floor(u * width)]!;
}

/** By how much a candidate is brighter than the truth, −255 to 255. Null for pictures of different sizes. */
export function difference(truth: Grey, candidate: Grey): Float32Array | null {
  if (truth.width !== candidate.width || truth.height !== candidate.height) return null;
  return Float32Array.from(candidate.values, (value, index) => value - truth.values[index]!);
}

const SIGMA = 1.5; // pixels
const RADIUS = 5;
const C1 = (0.01 * 255) ** 2;
const C2 = (0.03 * 255) ** 2;

/** The structural similarity of each pixel, −1 to 1 (Wang et al. 2004: Gaussian windows of 11 pixels, σ 1.5). */
export function similarity(truth: Grey, candidate: Grey): Float32Array | null {
  if (truth.width !== candidate.width || truth.height !== candidate.height) return null;
  const { width, height } = truth;
  const a = Float32Array.from(truth.values);
  const b = Float32Array.from(candidate.values);
  const blurred = (of: (index: number) => number): Float32Array => blur(a.map((_, index) => of(index)), width, height);
  const meanA = blur(a, width, height);
  const meanB = blur(b, width, height);
  const squareA = blurred((index) => a[index]! ** 2);
  const squareB = blurred((index) => b[index]! ** 2);
  const product = blurred((index) => a[index]! * b[index]!);
  return meanA.map((x, index) => {
    const y = meanB[index]!;
    const covariance = product[index]! - x * y;
    const variances = squareA[index]! - x * x + squareB[index]! - y * y;
    return ((2 * x * y + C1) * (2 * covariance + C2)) / ((x * x + y * y + C1) * (variances + C2));
  });
}

const WEIGHTS = (() => {
  const taps = Array.from({ length: 2 * RADIUS + 1 }, (_, at) => Math.exp(-((at - RADIUS) ** 2) / (2 * SIGMA ** 2)));
  const sum = taps.reduce((total, tap) => total + tap, 0);
  return taps.map((tap) => tap / sum);
})();

/** Along rows, then columns; at the edges the outermost pixels go on. */
function blur(values: Float32Array, width: number, height: number): Float32Array {
  return smoothed(smoothed(values, width, 1), height, width);
}

/** Along one side of a picture, of so many pixels, from each of which to the next it is `step` values. */
function smoothed(values: Float32Array, side: number, step: number): Float32Array {
  return values.map((_, index) => {
    const at = Math.floor(index / step) % side;
    let sum = 0;
    for (let tap = 0; tap < WEIGHTS.length; tap++) {
      const place = Math.max(0, Math.min(side - 1, at + tap - RADIUS));
      sum += WEIGHTS[tap]! * values[index + (place - at) * step]!;
    }
    return sum;
  });
}

/** The grey values at which the colours of a difference end. */
export const DIFFERENCE_END = 64;
/** Brighter and darker than the truth: orange and blue, which few people confuse; none is black. */
const BRIGHTER: Colour = [255, 168, 64];
const DARKER: Colour = [84, 164, 255];

export type Pixels = ImageData;

export function greyPixels({ width, height, values }: Grey): Pixels {
  return pixels(width, height, (index) => [values[index]!, values[index]!, values[index]!]);
}

export function differenceColour(value: number): Colour {
  const share = Math.min(1, Math.abs(value) / DIFFERENCE_END);
  const [r, g, b] = value > 0 ? BRIGHTER : DARKER;
  return [r * share, g * share, b * share];
}

/** Dark where the pictures agree not at all, light where they are alike. */
export function similarityColour(value: number): Colour {
  return ramp("coverage", value);
}

export function pixels(width: number, height: number, colour: (index: number) => Colour): Pixels {
  const image = new ImageData(width, height);
  for (let index = 0; index < width * height; index++) {
    image.data.set(colour(index), 4 * index);
    image.data[4 * index + 3] = 255;
  }
  return image;
}

/** What is measured against the truth, in this order: the scene's rendering, and the classical ways. */
export const MEASURED = ["rendering", "nearest", "linear", "median"] as const;
export type Measured = (typeof MEASURED)[number];

/** The metric of a frame for one of MEASURED; null: not measured yet, and its picture is not there. */
export function metricOf(frame: ComparedFrame, of: Measured, metric: Metric): number | null {
  return of === "rendering" ? frame[metric] : frame[`${of}_${metric}`];
}

/** Of the frames that are measured; null: none is. */
export function meanOf(frames: readonly ComparedFrame[], of: Measured, metric: Metric): number | null {
  const known = frames.map((frame) => metricOf(frame, of, metric)).filter((value) => value !== null);
  return known.length === 0 ? null : known.reduce((sum, value) => sum + value, 0) / known.length;
}

/** What is measured at the moment, and how many frames that is done for; null: all is. */
export function underWay(frames: readonly ComparedFrame[]): { way: Measured; done: number } | null {
  for (const way of MEASURED) {
    const done = frames.filter((frame) => metricOf(frame, way, "psnr_db") !== null).length;
    if (done < frames.length) return { way, done };
  }
  return null;
}

/** The places of the frames from the worst of a metric to the best; those that are not measured come last. */
export function worstFirst(frames: readonly ComparedFrame[], of: Measured, metric: Metric): number[] {
  const sign = LABELS[metric].higherIsBetter ? 1 : -1;
  const value = (place: number): number => sign * (metricOf(frames[place]!, of, metric) ?? sign * Number.MAX_VALUE);
  return frames.map((_, place) => place).sort((a, b) => value(a) - value(b));
}

/** Pearson's correlation of pairs; null of fewer than three, or where one side never changes. */
export function correlation(pairs: readonly (readonly [number, number])[]): number | null {
  if (pairs.length < 3) return null;
  const mean = (side: 0 | 1): number => pairs.reduce((sum, pair) => sum + pair[side], 0) / pairs.length;
  const [x, y] = [mean(0), mean(1)];
  const moment = (a: 0 | 1, b: 0 | 1): number =>
    pairs.reduce((sum, pair) => sum + (pair[a] - (a === 0 ? x : y)) * (pair[b] - (b === 0 ? x : y)), 0);
  const scale = Math.sqrt(moment(0, 0) * moment(1, 1));
  return scale > 0 ? moment(0, 1) / scale : null;
}

/** One line a frame: number, confidence and every metric of all that is measured. */
export function csvOf(frames: readonly ComparedFrame[]): string {
  const metrics = Object.keys(LABELS) as Metric[];
  const columns = MEASURED.flatMap((of) => metrics.map((metric) => ({ of, metric })));
  const head = ["frame_number", "confidence", ...columns.map(({ of, metric }) => `${of}_${metric}`)];
  const lines = frames.map((frame) =>
    [frame.frame_number, frame.confidence ?? "", ...columns.map(({ of, metric }) => metricOf(frame, of, metric) ?? "")].join(","),
  );
  return [head.join(","), ...lines, ""].join("\n");
}
