/** What the metrics of many frames say together. */

import type { ComparedFrame, Metric } from "../api/comparison";
import { LABELS } from "../shared/metrics";

/** What is measured against the truth: the scene's rendering, and the classical ways. */
export const CLASSICAL = ["median", "linear", "nearest"] as const;
export type Classical = (typeof CLASSICAL)[number];
export const MEASURED = ["rendering", ...CLASSICAL] as const;
export type Measured = (typeof MEASURED)[number];

/** The metric of a frame for one of MEASURED. */
export function metricOf(frame: ComparedFrame, of: Measured, metric: Metric): number {
  return of === "rendering" ? frame[metric] : frame[`${of}_${metric}`];
}

export function meanOf(frames: readonly ComparedFrame[], of: Measured, metric: Metric): number {
  return frames.reduce((sum, frame) => sum + metricOf(frame, of, metric), 0) / frames.length;
}

/** The places of the frames from the worst of a metric to the best. */
export function worstFirst(frames: readonly ComparedFrame[], of: Measured, metric: Metric): number[] {
  const sign = LABELS[metric].higherIsBetter ? 1 : -1;
  const value = (place: number): number => sign * metricOf(frames[place]!, of, metric);
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
    [frame.frame_number, frame.confidence ?? "", ...columns.map(({ of, metric }) => metricOf(frame, of, metric))].join(","),
  );
  return [head.join(","), ...lines, ""].join("\n");
}
