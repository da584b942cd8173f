/** A scene beside the frames that were held out from its training. */

import { getJson, segment } from "./client";

export const METRICS = ["psnr_db", "ms_ssim", "gms", "gmsd"] as const;
export type Metric = (typeof METRICS)[number];
export const PICTURES = ["truth", "rendering", "median", "difference"] as const;
export type ComparedPicture = (typeof PICTURES)[number];

export type ComparedFrame = { index: number; frame_number: number } & Record<Metric | `median_${Metric}`, number>;

export interface Comparison {
  state: "running" | "ready" | "failed";
  progress: number;
  dataset: string;
  frames: ComparedFrame[];
  reason: string | null;
}

/** Begins the comparison where it is not there. Throws ServiceError DATASET_NOT_FOUND without the scene's dataset. */
export function comparisonOf(scene: string, signal: AbortSignal): Promise<Comparison> {
  return getJson(`/v1/scenes/${segment(scene)}/comparison`, signal);
}

export function comparedPicturePath(scene: string, index: number, what: ComparedPicture): string {
  return `/v1/scenes/${segment(scene)}/comparison/${index}/${what}.png`;
}
