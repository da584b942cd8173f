/** Where the pixels of a picture lie in the image plane of the probe. */

import type { FrameHeader } from "../api/stream";
import {
  breadth_mm,
  pointOf,
  shareAbove,
  sharesOf,
  shortened,
  type ImagePlane,
  type Line,
  type PlanePoint,
} from "./plane";

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
