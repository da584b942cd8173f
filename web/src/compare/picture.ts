/** Grey pictures of the service as numbers, and what two of them make together. */

import { request } from "../api/client";

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
  const rows = new Float32Array(values.length);
  const result = new Float32Array(values.length);
  const inside = (at: number, size: number): number => Math.max(0, Math.min(size - 1, at));
  for (let y = 0; y < height; y++)
    for (let x = 0; x < width; x++) {
      let sum = 0;
      for (let tap = 0; tap < WEIGHTS.length; tap++) sum += WEIGHTS[tap]! * values[y * width + inside(x + tap - RADIUS, width)]!;
      rows[y * width + x] = sum;
    }
  for (let y = 0; y < height; y++)
    for (let x = 0; x < width; x++) {
      let sum = 0;
      for (let tap = 0; tap < WEIGHTS.length; tap++) sum += WEIGHTS[tap]! * rows[inside(y + tap - RADIUS, height) * width + x]!;
      result[y * width + x] = sum;
    }
  return result;
}
