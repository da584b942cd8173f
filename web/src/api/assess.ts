/** How far poses can be trusted, without rendering their frames. */

import type { Pose } from "../geometry/pose";
import { postJson, type Schemas } from "./client";
import type { Probe } from "./probes";

export type Extrapolation = Schemas["Extrapolation"];

/** Of each pose of a probe; null: the scene's own. */
export async function assessPoses(scene: string, poses: readonly Pose[], probe: Probe | null): Promise<Extrapolation[]> {
  const matrices = poses.map((pose) => ({ matrix: [0, 4, 8, 12].map((start) => pose.slice(start, start + 4)) }));
  return (await postJson("/v1/scenes/{scene}:assess", { scene }, { poses: matrices, probe })).extrapolations;
}
