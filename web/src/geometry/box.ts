/** The box that a sweep fills. */

import type { Probe } from "../api/scenes";
import type { Pose, Vector } from "./pose";

/** Corners in mm of the box around the image planes of a sweep, along the axes of its frame. */
export function boxOfSweep(views: readonly Pose[], probe: Probe): { low: Vector; high: Vector } {
  const low: [number, number, number] = [Infinity, Infinity, Infinity];
  const high: [number, number, number] = [-Infinity, -Infinity, -Infinity];
  for (const view of views)
    for (const [x, z] of cornersOf(probe))
      for (const axis of [0, 1, 2] as const) {
        const value = view[4 * axis]! * x + view[4 * axis + 2]! * z + view[4 * axis + 3]!;
        low[axis] = Math.min(low[axis], value);
        high[axis] = Math.max(high[axis], value);
      }
  return { low, high };
}

/** Lateral and axial, mm. */
function cornersOf(probe: Probe): [number, number][] {
  if (probe.kind === "linear") {
    const half = probe.width_mm / 2;
    return [-half, half].flatMap((x) => [probe.near_mm, probe.far_mm].map((z): [number, number] => [x, z]));
  }
  const half = (probe.opening_angle_deg / 360) * Math.PI;
  const near = probe.kind === "convex" ? probe.near_mm : 0;
  const reach = probe.far_mm * Math.sin(Math.min(half, Math.PI / 2));
  return [-reach, reach].flatMap((x) => [near * Math.cos(half), probe.far_mm].map((z): [number, number] => [x, z]));
}
