/** Poses that are steered: motions along and about the probe's own axes (x lateral, y elevation, z axial; mm and degrees). */

import { type Pose, rotated, translated } from "./pose.js";

export interface Motion {
  /** mm along the probe's axes. */
  x?: number;
  y?: number;
  z?: number;
  /** Degrees about its elevation axis (rock), its lateral axis (tilt) and its axial axis (rotate). */
  rock?: number;
  tilt?: number;
  rotate?: number;
}

/** The pose after a motion; turns are about a point on the axial axis, `pivot_mm` from the origin. */
export function moved(pose: Pose, { x = 0, y = 0, z = 0, rock = 0, tilt = 0, rotate = 0 }: Motion, pivot_mm = 0): Pose {
  return rotated(translated(pose, [x, y, z]), [tilt, rock, rotate], pivot_mm);
}
