/** The box that a sweep fills. */

import type { Line } from "./plane";
import type { Pose, Vector } from "./pose";

/** Corners in mm of the box around the image planes of a sweep, along the axes of its frame. */
export function boxOfSweep(views: readonly Pose[], lines: readonly Line[]): { low: Vector; high: Vector } {
  const low: [number, number, number] = [Infinity, Infinity, Infinity];
  const high: [number, number, number] = [-Infinity, -Infinity, -Infinity];
  const ends = lines.flatMap(([x0, z0, x1, z1]) => [[x0, z0] as const, [x1, z1] as const]);
  for (const view of views)
    for (const [x, z] of ends)
      for (const axis of [0, 1, 2] as const) {
        const value = view[4 * axis]! * x + view[4 * axis + 2]! * z + view[4 * axis + 3]!;
        low[axis] = Math.min(low[axis], value);
        high[axis] = Math.max(high[axis], value);
      }
  return { low, high };
}
