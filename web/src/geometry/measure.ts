/** What is measured in an image plane: distances, ellipses and angles, from the points that a person sets. */

import { distanceBetween_mm } from "./picture";
import type { PlanePoint } from "./plane";

/** The ends of one axis, and a point that the ellipse passes through at the end of the other. */
export type EllipsePoints = readonly [PlanePoint, PlanePoint, PlanePoint];

export interface Ellipse {
  centre: PlanePoint;
  /** Half of the axis that was set first, and of the other. */
  first_mm: number;
  second_mm: number;
  /** From the x axis to the first one. */
  turn_deg: number;
}

export function ellipseOf([a, b, c]: EllipsePoints): Ellipse {
  const centre = middleOf(a, b);
  return {
    centre,
    first_mm: distanceBetween_mm(a, b) / 2,
    second_mm: distanceBetween_mm(centre, c),
    turn_deg: (Math.atan2(b.z_mm - a.z_mm, b.x_mm - a.x_mm) * 180) / Math.PI,
  };
}

/** The end of the other axis, square to a–b, that is as far from it as a point. */
export function squareTo(a: PlanePoint, b: PlanePoint, point: PlanePoint): PlanePoint {
  const centre = middleOf(a, b);
  const length_mm = distanceBetween_mm(a, b);
  if (length_mm === 0) return centre;
  const [x, z] = [-(b.z_mm - a.z_mm) / length_mm, (b.x_mm - a.x_mm) / length_mm];
  const away_mm = (point.x_mm - centre.x_mm) * x + (point.z_mm - centre.z_mm) * z;
  return { x_mm: centre.x_mm + x * away_mm, z_mm: centre.z_mm + z * away_mm };
}

/** The same point after an end of a–b moved: as far from the axis as it was, on the same side. */
export function carried([a, b, c]: EllipsePoints, a2: PlanePoint, b2: PlanePoint): PlanePoint {
  const { second_mm } = ellipseOf([a, b, c]);
  const side = Math.sign((b.x_mm - a.x_mm) * (c.z_mm - a.z_mm) - (b.z_mm - a.z_mm) * (c.x_mm - a.x_mm)) || 1;
  const length_mm = distanceBetween_mm(a2, b2) || 1;
  const centre = middleOf(a2, b2);
  return {
    x_mm: centre.x_mm - (side * second_mm * (b2.z_mm - a2.z_mm)) / length_mm,
    z_mm: centre.z_mm + (side * second_mm * (b2.x_mm - a2.x_mm)) / length_mm,
  };
}

export function area_mm2({ first_mm, second_mm }: Ellipse): number {
  return Math.PI * first_mm * second_mm;
}

/** Ramanujan's second approximation: right to 0.04 % for a line, and far better for what is round. */
export function circumference_mm({ first_mm: a, second_mm: b }: Ellipse): number {
  const h = a + b === 0 ? 0 : ((a - b) / (a + b)) ** 2;
  return Math.PI * (a + b) * (1 + (3 * h) / (10 + Math.sqrt(4 - 3 * h)));
}

/** The angle at the middle one of three points, 0° to 180°. */
export function angleAt_deg([a, vertex, b]: readonly [PlanePoint, PlanePoint, PlanePoint]): number {
  const [ux, uz] = [a.x_mm - vertex.x_mm, a.z_mm - vertex.z_mm];
  const [vx, vz] = [b.x_mm - vertex.x_mm, b.z_mm - vertex.z_mm];
  return Math.abs(Math.atan2(ux * vz - uz * vx, ux * vx + uz * vz) * 180) / Math.PI;
}

export function middleOf(a: PlanePoint, b: PlanePoint): PlanePoint {
  return { x_mm: (a.x_mm + b.x_mm) / 2, z_mm: (a.z_mm + b.z_mm) / 2 };
}
