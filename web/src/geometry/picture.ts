/** Where the pixels of a picture lie in the image plane of the probe: x lateral, z axial, both in mm. */

import type { Probe } from "../api/scenes";

/** As in a frame's header: columns in mm, or in degrees where each is a scan line of a fan. */
export interface Picture {
  column_unit: "mm" | "deg";
  first: [number, number];
  step: [number, number];
}

export interface PlanePoint {
  x_mm: number;
  z_mm: number;
}

/** A picture with its size, and what is needed to place pixels. */
export interface Placed {
  picture: Picture;
  height: number;
  width: number;
}

/** The depth of the face on the axis: the radius of a convex array, else 0. */
export function faceDepth_mm(probe: Probe): number {
  return probe.kind === "convex" ? probe.near_mm : 0;
}

export function nearDepth_mm(probe: Probe): number {
  return probe.kind === "phased" ? 0 : probe.near_mm;
}

/** Width and height of the picture on a screen, in mm; of a fan as it is stored, its width is taken half way down. */
export function extent_mm({ picture, height, width }: Placed): { across: number; down: number } {
  const down = Math.abs(picture.step[1]) * height;
  const across = Math.abs(picture.step[0]) * width;
  if (picture.column_unit === "mm") return { across, down };
  return { across: (across / 180) * Math.PI * (picture.first[1] + down / 2), down };
}

/** The point at a column and a row; centres of pixels have whole numbers. */
export function pointAt({ picture }: Placed, column: number, row: number): PlanePoint {
  const across = picture.first[0] + picture.step[0] * column;
  const down = picture.first[1] + picture.step[1] * row;
  if (picture.column_unit === "mm") return { x_mm: across, z_mm: down };
  const angle = (across / 180) * Math.PI;
  return { x_mm: down * Math.sin(angle), z_mm: down * Math.cos(angle) };
}

/** Its inverse: column and row of a point. */
export function pixelAt({ picture }: Placed, { x_mm, z_mm }: PlanePoint): { column: number; row: number } {
  const polar = picture.column_unit === "deg";
  const across = polar ? (Math.atan2(x_mm, z_mm) / Math.PI) * 180 : x_mm;
  const down = polar ? Math.hypot(x_mm, z_mm) : z_mm;
  return { column: (across - picture.first[0]) / picture.step[0], row: (down - picture.first[1]) / picture.step[1] };
}

/** The probe as far as a picture of it goes, which may end above the depth of the probe. */
export function shownProbe({ picture, height }: Placed, probe: Probe): Probe {
  const end_mm = picture.first[1] + picture.step[1] * (height - 0.5);
  return { ...probe, far_mm: Math.min(probe.far_mm, end_mm) };
}

/** Whether a pixel shows something: a scan-converted fan leaves corners. */
export function isShown(placed: Placed, probe: Probe, column: number, row: number): boolean {
  if (probe.kind === "linear" || placed.picture.column_unit === "deg") return true;
  const { x_mm, z_mm } = pointAt(placed, column, row);
  const range_mm = Math.hypot(x_mm, z_mm);
  const half = (probe.opening_angle_deg / 360) * Math.PI;
  const within = range_mm >= nearDepth_mm(probe) && range_mm <= shownProbe(placed, probe).far_mm;
  return within && Math.abs(Math.atan2(x_mm, z_mm)) <= half;
}

/** Depth below the face, as a scanner counts it: along z, of a fan as it is stored along the scan line. */
export function depthAtRow({ picture }: Placed, row: number, probe: Probe): number {
  return picture.first[1] + picture.step[1] * row - faceDepth_mm(probe);
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
export function depthTicks(placed: Placed, probe: Probe): Tick[] {
  const start = depthAtRow(placed, -0.5, probe);
  const end = depthAtRow(placed, placed.height - 0.5, probe);
  return ticksOver(start, end, (depth) => (depth - depthAtRow(placed, 0, probe)) / placed.picture.step[1]);
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
