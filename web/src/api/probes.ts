/** Probes: what the service knows of their kinds, and where the scan lines of one run. */

import { postJson, type Schemas } from "./client";
import type { Described } from "./described";
import { settings } from "./generated/contract";

export type Probe = NonNullable<Schemas["DatasetRecord"]["probe"]>;
/** Where the scan lines run in the image plane. */
export type ImagePlane = Schemas["ImagePlane"];

/** The numbers that a probe of each kind is made of. */
export const PROBE_KINDS: ReadonlyMap<string, Described> = new Map(
  (settings.properties?.probe?.oneOf ?? []).map((one) => [String(one.properties?.kind?.const), one]),
);

/** A probe of that kind which looks so deep. */
export function exampleProbe(kind: string, depth_mm: number): Probe {
  const example = PROBE_KINDS.get(kind)?.examples?.[0] as Probe & { near_mm?: number };
  return { ...example, far_mm: (example.near_mm ?? 0) + depth_mm };
}

/** Throws ServiceError for a probe that cannot be. */
export function imagePlane(probe: Probe): Promise<ImagePlane> {
  return postJson("/v1/probes:plane", {}, probe);
}
