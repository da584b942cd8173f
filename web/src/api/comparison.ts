/** A scene beside the frames that were held out from its training. */

import { address, getJson, type Schemas } from "./client";
import type { paths } from "./generated/schema";

export type Comparison = Schemas["Comparison"];
export type ComparedFrame = Schemas["ComparedFrame"];
type MetricOf<Field> = Field extends `median_${infer Name}` ? Name : never;
export type Metric = MetricOf<keyof Schemas["ComparedFrame"]>;
export type ComparedPicture =
  paths["/v1/scenes/{scene}/comparison/{index}/{what}.png"]["get"]["parameters"]["path"]["what"];

/** Begins the comparison where it is not there. Throws ServiceError DATASET_NOT_FOUND without the scene's dataset. */
export function comparisonOf(scene: string, signal: AbortSignal): Promise<Comparison> {
  return getJson("/v1/scenes/{scene}/comparison", { scene }, { signal });
}

export function comparedPicturePath(scene: string, index: number, what: ComparedPicture): string {
  return address("/v1/scenes/{scene}/comparison/{index}/{what}.png", { scene, index, what });
}
