/** Poses that are steered: motions along and about the probe's own axes (x lateral, y elevation, z axial; mm and degrees). */

import type { Pose } from "./scene.js";

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

type Matrix = number[];

function product(a: Matrix, b: Matrix): Matrix {
  return Array.from({ length: 16 }, (_, at) => {
    const [row, column] = [Math.floor(at / 4), at % 4];
    return [0, 1, 2, 3].reduce((sum, k) => sum + a[4 * row + k]! * b[4 * k + column]!, 0);
  });
}

function about(axis: 0 | 1 | 2, degrees: number): Matrix {
  const [cosine, sine] = [Math.cos((degrees * Math.PI) / 180), Math.sin((degrees * Math.PI) / 180)];
  const [first, second] = [(axis + 1) % 3, (axis + 2) % 3];
  const turn = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  turn[5 * first] = turn[5 * second] = cosine;
  turn[4 * first + second] = -sine;
  turn[4 * second + first] = sine;
  return turn;
}

/** The pose after a motion; turns are about a point on the axial axis, `pivot_mm` from the origin. */
export function moved(pose: Pose, { x = 0, y = 0, z = 0, rock = 0, tilt = 0, rotate = 0 }: Motion, pivot_mm = 0): Pose {
  const shift = (dx: number, dy: number, dz: number): Matrix => [1, 0, 0, dx, 0, 1, 0, dy, 0, 0, 1, dz, 0, 0, 0, 1];
  const turns = [about(1, rock), about(0, tilt), about(2, rotate)].reduce(product);
  const motion = [shift(x, y, z + pivot_mm), turns, shift(0, 0, -pivot_mm)].reduce(product);
  return product([...pose], motion);
}
