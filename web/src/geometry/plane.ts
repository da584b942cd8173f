/** The image plane of a probe, told by its scan lines: x lateral, z axial, both in mm. */

import type { ImagePlane } from "../api/probes";

export type { ImagePlane };
/** A scan line: x and z where the image begins, x and z where it ends. */
export type Line = ImagePlane["lines_mm"][number];

export interface PlanePoint {
  x_mm: number;
  z_mm: number;
}

/** The point at shares of the way from the first line to the last, and along the lines. */
export function pointOf(lines: readonly Line[], across: number, along: number): PlanePoint {
  const at = across * (lines.length - 1);
  const index = Math.max(0, Math.min(lines.length - 2, Math.floor(at)));
  const [x0, z0, x1, z1] = between(lines[index]!, lines[index + 1]!, at - index);
  return { x_mm: x0 + (x1 - x0) * along, z_mm: z0 + (z1 - z0) * along };
}

/** Its inverse: the shares of a point, beyond 0 to 1 outside the image. */
export function sharesOf(lines: readonly Line[], point: PlanePoint): { across: number; along: number } {
  const last = lines.length - 2;
  const sides = lines.map((line) => side(line, point));
  let found = Math.abs(sides[0]!) < Math.abs(sides[last + 1]!) ? 0 : last;
  for (let index = 0; index <= last; index++)
    if (sides[index]! >= 0 && sides[index + 1]! <= 0 && along(lines[index]!, point) >= 0) found = index;
  const [left, right] = [sides[found]!, sides[found + 1]!];
  const share = left === right ? 0 : left / (left - right);
  return { across: (found + share) / (last + 1), along: along(between(lines[found]!, lines[found + 1]!, share), point) };
}

/** How far a point lies from a line, mm; more than 0 on the side of larger x of a line that runs down. */
function side([x0, z0, x1, z1]: Line, { x_mm, z_mm }: PlanePoint): number {
  return ((x_mm - x0) * (z1 - z0) - (z_mm - z0) * (x1 - x0)) / Math.hypot(x1 - x0, z1 - z0);
}

/** The share of a line at which it comes closest to a point. */
function along([x0, z0, x1, z1]: Line, { x_mm, z_mm }: PlanePoint): number {
  return ((x_mm - x0) * (x1 - x0) + (z_mm - z0) * (z1 - z0)) / ((x1 - x0) ** 2 + (z1 - z0) ** 2);
}

function between(a: Line, b: Line, share: number): Line {
  return a.map((value, i) => value + (b[i]! - value) * share) as Line;
}

/** The lines up to a share of their length. */
export function shortened(lines: readonly Line[], share: number): Line[] {
  return lines.map(([x0, z0, x1, z1]) => [x0, z0, x0 + (x1 - x0) * share, z0 + (z1 - z0) * share]);
}

/** The share of the lines that ends at a depth along z. */
export function shareAbove(lines: readonly Line[], depth_mm: number): number {
  const shares = lines.map(([, z0, , z1]) => (z1 > z0 ? (depth_mm - z0) / (z1 - z0) : 1));
  return Math.max(0, Math.min(1, ...shares));
}

/** The smallest rectangle that holds the image. */
export function boxOf(lines: readonly Line[]): { left: number; right: number; top: number; bottom: number } {
  const x = lines.flatMap(([x0, , x1]) => [x0, x1]);
  const z = lines.flatMap(([, z0, , z1]) => [z0, z1]);
  return { left: Math.min(...x), right: Math.max(...x), top: Math.min(...z), bottom: Math.max(...z) };
}

/** Whether all lines run along z: frames as they are stored are true to scale. */
export function areUpright(lines: readonly Line[]): boolean {
  return lines.every(([x0, , x1]) => Math.abs(x1 - x0) < 1e-6);
}

/** Whether the last line is the first one again. */
export function areAllAround(lines: readonly Line[]): boolean {
  const [first, last] = [lines[0]!, lines.at(-1)!];
  return Math.hypot(first[2] - last[2], first[3] - last[3]) < 1e-3;
}

/** The length of the way across the image at a share of the lines. */
export function breadth_mm(lines: readonly Line[], share: number): number {
  const points = shortened(lines, share).map(([, , x, z]) => [x, z] as const);
  return points.slice(1).reduce((sum, [x, z], i) => sum + Math.hypot(x - points[i]![0], z - points[i]![1]), 0);
}
