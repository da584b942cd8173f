/** The image plane of a probe (x lateral, z axial, mm): its scan lines, where the pixels of a picture lie on it, what is measured there. */

import type { FrameHeader, ImagePlane } from "../api/contract";
import type { Pose, Vector } from "./pose";

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

/** The pixel of a scan-converted picture of so many on its longer side; null where frames are pictures already. */
export function squarePixel_mm(lines: readonly Line[], most: number): number | null {
  if (areUpright(lines)) return null;
  const { left, right, top, bottom } = boxOf(lines);
  return Math.max(right - left, bottom - top) / most;
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

type Picture = FrameHeader["picture"];

/** A picture with its size, and the scan lines that it shows. */
export interface Placed {
  picture: Picture;
  height: number;
  width: number;
  /** As far as the picture goes, which may end above the depth of the probe. */
  lines: readonly Line[];
  /** Where rulers begin: at the middle of the face, or where the face lies on each stored line. */
  zero_mm: number;
  /** Whether each column is a scan line, as frames are stored; else the pixels are square. */
  isStored: boolean;
}

/** Puts a picture on the plane of its probe. `shownShare`: of stored scan lines, null for square pixels. */
export function placedOn(
  { lines_mm, face_depth_mm, pivot_depth_mm }: ImagePlane,
  sized: { picture: Picture; height: number; width: number },
  shownShare: number | null,
): Placed {
  const end_mm = sized.picture.first[1] + sized.picture.step[1] * (sized.height - 0.5);
  const lines = shortened(lines_mm, shownShare ?? shareAbove(lines_mm, end_mm));
  const isStored = shownShare !== null;
  return { ...sized, lines, zero_mm: isStored ? face_depth_mm : pivot_depth_mm, isStored };
}

/** Width and height of the picture on a screen, in mm; of a fan as it is stored, its width is taken half way down. */
export function extent_mm({ picture, height, width, lines, isStored }: Placed): { across: number; down: number } {
  const down = Math.abs(picture.step[1]) * height;
  return { across: isStored ? breadth_mm(lines, 0.5) : Math.abs(picture.step[0]) * width, down };
}

/** The point at a column and a row; centres of pixels have whole numbers. */
export function pointAt({ picture, height, width, lines, isStored }: Placed, column: number, row: number): PlanePoint {
  const { first, step } = picture;
  if (!isStored) return { x_mm: first[0] + step[0] * column, z_mm: first[1] + step[1] * row };
  const across = (column + 0.5) / width;
  return pointOf(lines, step[0] < 0 ? 1 - across : across, (row + 0.5) / height);
}

/** Its inverse: column and row of a point. */
export function pixelAt(
  { picture, height, width, lines, isStored }: Placed,
  point: PlanePoint,
): { column: number; row: number } {
  const { first, step } = picture;
  if (!isStored) return { column: (point.x_mm - first[0]) / step[0], row: (point.z_mm - first[1]) / step[1] };
  const { across, along } = sharesOf(lines, point);
  return { column: (step[0] < 0 ? 1 - across : across) * width - 0.5, row: along * height - 0.5 };
}

/** Whether a pixel shows something: a scan-converted fan leaves corners. */
export function isShown(placed: Placed, column: number, row: number): boolean {
  if (placed.isStored) return true;
  const { across, along } = sharesOf(placed.lines, pointAt(placed, column, row));
  return across >= 0 && across <= 1 && along >= 0 && along <= 1;
}

/** The polygon in which a picture shows something, in shares of its width and height; null: all of it. */
export function outline(placed: Placed): [number, number][] | null {
  if (placed.isStored) return null;
  const ends = placed.lines.map(([x0, z0, x1, z1]) => [{ x_mm: x0, z_mm: z0 }, { x_mm: x1, z_mm: z1 }] as const);
  return [...ends.map(([near]) => near), ...ends.map(([, far]) => far).reverse()].map((point) => {
    const { column, row } = pixelAt(placed, point);
    return [(column + 0.5) / placed.width, (row + 0.5) / placed.height];
  });
}

/** Depth below the face, as a scanner counts it: along z, of a fan as it is stored along the scan line. */
export function depthAtRow({ picture, zero_mm }: Placed, row: number): number {
  return picture.first[1] + picture.step[1] * row - zero_mm;
}

export function distanceBetween_mm(a: PlanePoint, b: PlanePoint): number {
  return Math.hypot(a.x_mm - b.x_mm, a.z_mm - b.z_mm);
}

export interface Tick {
  /** In pixels of the picture, from the middle of the first one. */
  at: number;
  /** Centimetres, on every second tick. */
  label: string | null;
}

/** Ticks every 5 mm of depth. */
export function depthTicks(placed: Placed): Tick[] {
  const start = depthAtRow(placed, -0.5);
  const end = depthAtRow(placed, placed.height - 0.5);
  return ticksOver(start, end, (depth) => (depth - depthAtRow(placed, 0)) / placed.picture.step[1]);
}

/** Ticks every 5 mm across, 0 being the axis; none where columns are angles. */
export function lateralTicks({ picture, width }: Placed): Tick[] {
  if (picture.column_unit === "deg") return [];
  const at = (column: number): number => picture.first[0] + picture.step[0] * column;
  const [a, b] = [at(-0.5), at(width - 0.5)];
  return ticksOver(Math.min(a, b), Math.max(a, b), (x) => (x - picture.first[0]) / picture.step[0]);
}

function ticksOver(start_mm: number, end_mm: number, place: (mm: number) => number): Tick[] {
  const ticks: Tick[] = [];
  const spacing = end_mm - start_mm > 200 ? 10 : 5;
  for (let step = Math.ceil(start_mm / spacing - 1e-6); step * spacing <= end_mm + 1e-6; step++)
    ticks.push({ at: place(step * spacing), label: step % 2 === 0 ? String((step * spacing) / 10) : null });
  return ticks;
}

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

/** Points all around it. */
export function rimOf([a, b, c]: EllipsePoints, count: number): PlanePoint[] {
  const centre = middleOf(a, b);
  const at = (turn: number, of: "x_mm" | "z_mm"): number =>
    centre[of] + Math.cos(turn) * (b[of] - centre[of]) + Math.sin(turn) * (c[of] - centre[of]);
  return Array.from({ length: count }, (_, index) => (2 * Math.PI * index) / count).map((turn) => ({ x_mm: at(turn, "x_mm"), z_mm: at(turn, "z_mm") }));
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

export interface Box {
  left: number;
  top: number;
  width: number;
  height: number;
}

/** A text that stands beside a point. */
export interface Label {
  x: number;
  y: number;
  width: number;
  height: number;
}

const AWAY = [9, 22, 38]; // pixels from the point
const DIRECTIONS = [[1, -1], [1, 1], [-1, -1], [-1, 1], [1, 0], [-1, 0], [0, -1], [0, 1]] as const; // prettier-ignore

/** A box for each label within `area`: the nearest to its point that is free; over another only where nothing is. */
export function placeLabels(labels: readonly Label[], area: Box, taken: readonly Box[] = []): Box[] {
  const placed = [...taken];
  return labels.map((label) => {
    const choices = AWAY.flatMap((away) => DIRECTIONS.map((direction) => beside(label, direction, away)));
    const inside = choices.filter((box) => isWithin(box, area));
    const box = inside.find((one) => !placed.some((other) => overlap(one, other))) ?? inside[0] ?? choices[0]!;
    placed.push(box);
    return box;
  });
}

export function overlap(a: Box, b: Box): boolean {
  return a.left < b.left + b.width && b.left < a.left + a.width && a.top < b.top + b.height && b.top < a.top + a.height;
}

function beside({ x, y, width, height }: Label, [across, down]: readonly [number, number], away: number): Box {
  return {
    left: x + across * (away + width / 2) - width / 2,
    top: y + down * (away + height / 2) - height / 2,
    width,
    height,
  };
}

function isWithin(box: Box, area: Box): boolean {
  return (
    box.left >= area.left &&
    box.top >= area.top &&
    box.left + box.width <= area.left + area.width &&
    box.top + box.height <= area.top + area.height
  );
}

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
