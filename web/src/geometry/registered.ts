/** Poses as a robot or a tracker tells them: flange to base, or marker to tracker, in place of probe to scene. */

import type { Registration } from "../api/registrations";
import { apply, composed, inverse, position, type Pose, type Vector } from "./pose";
import { length } from "./vector";

/** What a registration makes of poses. */
export interface Registered {
  name: string;
  baseToScene: Pose;
  probeToFlange: Pose;
}

export function registeredBy({ name, base_to_scene, probe_to_flange }: Registration): Registered {
  return { name, baseToScene: base_to_scene.flat(), probeToFlange: probe_to_flange.flat() };
}

/** Whether both convert every pose alike. */
export function leadAlike(one: Registered, other: Registered): boolean {
  const same = (of: Pose, as: Pose): boolean => of.every((value, place) => value === as[place]);
  return same(one.baseToScene, other.baseToScene) && same(one.probeToFlange, other.probeToFlange);
}

/** Flange to base of a pose of the probe in the scene. */
export function flangePose({ baseToScene, probeToFlange }: Registered, pose: Pose): Pose {
  return composed(inverse(baseToScene), composed(pose, inverse(probeToFlange)));
}

/** Its inverse. */
export function probePose({ baseToScene, probeToFlange }: Registered, flange: Pose): Pose {
  return composed(baseToScene, composed(flange, probeToFlange));
}

/** The corners of a box about all places of the flange whose probe is within a box of the scene. */
export function flangeBounds({ baseToScene, probeToFlange }: Registered, low: Vector, high: Vector): { low: Vector; high: Vector } {
  const back = inverse(baseToScene);
  const reach_mm = length(position(probeToFlange));
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((bits) =>
    apply(back, [0, 1, 2].map((axis) => (bits & (1 << axis) ? high : low)[axis]!) as unknown as Vector),
  );
  const outermost = (choose: (...values: number[]) => number, by_mm: number): Vector =>
    [0, 1, 2].map((axis) => choose(...corners.map((corner) => corner[axis]!)) + by_mm) as unknown as Vector;
  return { low: outermost(Math.min, -reach_mm), high: outermost(Math.max, reach_mm) };
}
