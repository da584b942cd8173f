/** The skin as the sweep tells it: a smooth surface through the faces of its views, on which the probe can be kept. */

import type { ImagePlane } from "../api/contract";
import { areAllAround } from "./plane";
import {
  apply, axis, cross, dot, length, minus, multiply, pivoted, plus, type Pose, quaternion, type Quaternion,
  scaled, translated, unit, type Vector,
} from "./pose";

const FACE_POINTS = 9; // of each view
const MARGIN_MM = 15; // beyond the sweep the surface goes on
const MOST_CELLS = 64; // each way
const LEAST_CELL_MM = 1;
const LEAST_AGREEMENT = 0.6; // of the axes of the views, 1 where all run alike: around a limb there is no height
const SETTLED = 6; // times what lies between the faces is smoothed before all of it is, once
const NEAR_CELLS = 3; // a cell so near to a face is shown
const LEAST_SLOPE = 0.2; // of what runs into the surface: below, it would be met far away
const STEPS = 12;

/** Heights over a plane, in cells. */
export class Skin {
  constructor(
    /** The corner of the first cell. */
    private readonly origin: Vector,
    /** Along the cells, across them, and out of the body. */
    private readonly axes: readonly [Vector, Vector, Vector],
    readonly cell_mm: number,
    readonly columns: number,
    readonly rows: number,
    private readonly heights: Float32Array,
    /** Whether a face was near, by cell. */
    readonly near: Uint8Array,
  ) {}

  /** The height of a point over the skin, mm; less than 0 within the body. */
  above(point: Vector): number {
    const from = minus(point, this.origin);
    return dot(from, this.axes[2]) - this.#height(dot(from, this.axes[0]), dot(from, this.axes[1]));
  }

  /** Out of the body. */
  normal(point: Vector): Vector {
    const from = minus(point, this.origin);
    const [u, v] = [dot(from, this.axes[0]), dot(from, this.axes[1])];
    const step = this.cell_mm;
    const along = (this.#height(u + step, v) - this.#height(u - step, v)) / (2 * step);
    const across = (this.#height(u, v + step) - this.#height(u, v - step)) / (2 * step);
    const [a, b, out] = this.axes;
    return unit(minus(out, plus(scaled(a, along), scaled(b, across))));
  }

  /** How far it is from a point to the skin in a direction, mm; less than 0 where the skin lies behind. */
  distance(point: Vector, direction: Vector): number {
    const slope = dot(direction, this.axes[2]);
    const fall = Math.abs(slope) < LEAST_SLOPE ? Math.sign(slope || -1) * LEAST_SLOPE : slope;
    let along = 0;
    for (let step = 0; step < STEPS; step++) along -= this.above(plus(point, scaled(direction, along))) / fall;
    return along;
  }

  /** The point of the skin at a corner of the cells. */
  corner(column: number, row: number): Vector {
    const [a, b, out] = this.axes;
    const base = plus(this.origin, plus(scaled(a, column * this.cell_mm), scaled(b, row * this.cell_mm)));
    return plus(base, scaled(out, this.heights[row * this.columns + column]!));
  }

  #height(u: number, v: number): number {
    const x = Math.max(0, Math.min(this.columns - 1.001, u / this.cell_mm));
    const y = Math.max(0, Math.min(this.rows - 1.001, v / this.cell_mm));
    const [i, j] = [Math.floor(x), Math.floor(y)];
    const at = (column: number, row: number): number => this.heights[row * this.columns + column]!;
    const above = at(i, j) + (at(i + 1, j) - at(i, j)) * (x - i);
    const below = at(i, j + 1) + (at(i + 1, j + 1) - at(i, j + 1)) * (x - i);
    return above + (below - above) * (y - j);
  }
}

/** The skin under a sweep; null where its views look in all directions, as around a limb or out of a vessel. */
export function skinOf(views: readonly Pose[], { lines_mm }: ImagePlane): Skin | null {
  if (views.length < 2 || areAllAround(lines_mm)) return null;
  const down = scaled(views.map((view) => axis(view, 2)).reduce(plus), 1 / views.length);
  if (length(down) < LEAST_AGREEMENT) return null;
  const out = unit(scaled(down, -1));
  const lateral = axis(views[views.length >> 1]!, 0);
  const a = unit(minus(lateral, scaled(out, dot(lateral, out))));
  const axes = [a, cross(out, a), out] as const;
  const step = (lines_mm.length - 1) / (FACE_POINTS - 1);
  const face = Array.from({ length: FACE_POINTS }, (_, i) => lines_mm[Math.round(i * step)]!);
  const points = views.flatMap((view) => face.map(([x, z]) => apply(view, [x, 0, z]))).map(
    (point): Vector => [dot(point, axes[0]), dot(point, axes[1]), dot(point, axes[2])],
  );
  const low = [0, 1].map((i) => Math.min(...points.map((point) => point[i]!)) - MARGIN_MM);
  const high = [0, 1].map((i) => Math.max(...points.map((point) => point[i]!)) + MARGIN_MM);
  const cell_mm = Math.max(LEAST_CELL_MM, Math.max(high[0]! - low[0]!, high[1]! - low[1]!) / (MOST_CELLS - 1));
  const [columns, rows] = [0, 1].map((i) => Math.ceil((high[i]! - low[i]!) / cell_mm) + 1) as [number, number];
  const sums = new Float32Array(columns * rows);
  const counts = new Float32Array(columns * rows);
  for (const [u, v, height] of points) {
    const cell = Math.round((v - low[1]!) / cell_mm) * columns + Math.round((u - low[0]!) / cell_mm);
    sums[cell]! += height;
    counts[cell]! += 1;
  }
  const near = grown(counts, columns, rows, NEAR_CELLS);
  let heights = filled(sums, counts, columns, rows);
  for (let time = 0; time < SETTLED; time++) {
    const settled = smoothed(heights, columns, rows);
    heights = heights.map((height, cell) => (counts[cell]! > 0 ? height : settled[cell]!));
  }
  heights = smoothed(heights, columns, rows);
  const origin = plus(scaled(axes[0], low[0]!), scaled(axes[1], low[1]!));
  return new Skin(origin, axes, cell_mm, columns, rows, heights, near);
}

/** The pose `after`, moved along the probe until its face is pressed as far as `before`, or as far as was pressed since.
 *
 * It turns with the skin: the probe keeps its tilt against it. What lifts the probe off is left out.
 */
export function keptOn(skin: Skin, before: Pose, after: Pose, pivot_mm: number): Pose {
  const [from, to] = [before, after].map((pose) => apply(pose, [0, 0, pivot_mm])) as [Vector, Vector];
  const axial = axis(before, 2);
  const pressed = Math.max(0, -skin.distance(from, axial)) + dot(minus(to, from), axial);
  const turn = between(skin.normal(from), skin.normal(to));
  const turned = pivoted(after, multiply(turn, quaternion(after)), pivot_mm);
  return translated(turned, [0, 0, skin.distance(to, axis(turned, 2)) + Math.max(0, pressed)]);
}

/** The pose with its face on the skin, along the probe. */
export function putOn(skin: Skin, pose: Pose, pivot_mm: number): Pose {
  return translated(pose, [0, 0, skin.distance(apply(pose, [0, 0, pivot_mm]), axis(pose, 2))]);
}

/** The shortest turn from one direction to another. */
function between(a: Vector, b: Vector): Quaternion {
  const [x, y, z] = cross(a, b);
  return [1 + dot(a, b), x, y, z]; // its length does not matter
}

/** Means where there are values, and between them what a coarser grid says. */
function filled(sums: Float32Array, counts: Float32Array, columns: number, rows: number): Float32Array {
  if (columns * rows === 1) return sums.map((sum, i) => sum / (counts[i] || 1));
  const [halfColumns, halfRows] = [(columns + 1) >> 1, (rows + 1) >> 1];
  const coarseSums = new Float32Array(halfColumns * halfRows);
  const coarseCounts = new Float32Array(halfColumns * halfRows);
  const parent = (index: number): number => (Math.floor(index / columns) >> 1) * halfColumns + ((index % columns) >> 1);
  for (const [index, count] of counts.entries()) {
    if (count === 0) continue;
    coarseSums[parent(index)]! += sums[index]! / count;
    coarseCounts[parent(index)]! += 1;
  }
  let coarse = filled(coarseSums, coarseCounts, halfColumns, halfRows);
  coarse = smoothed(coarse, halfColumns, halfRows);
  return sums.map((sum, index) => (counts[index]! > 0 ? sum / counts[index]! : coarse[parent(index)]!));
}

/** Each the mean of itself and its neighbours. */
function smoothed(values: Float32Array, columns: number, rows: number): Float32Array {
  return values.map((_, index) => {
    const [column, row] = [index % columns, Math.floor(index / columns)];
    let sum = 0;
    let count = 0;
    for (let j = Math.max(0, row - 1); j <= Math.min(rows - 1, row + 1); j++)
      for (let i = Math.max(0, column - 1); i <= Math.min(columns - 1, column + 1); i++) {
        sum += values[j * columns + i]!;
        count += 1;
      }
    return sum / count;
  });
}

/** Whether a cell with a value is so near. */
function grown(counts: Float32Array, columns: number, rows: number, cells: number): Uint8Array {
  const near = new Uint8Array(counts.length);
  for (const [index, count] of counts.entries()) {
    if (count === 0) continue;
    const [column, row] = [index % columns, Math.floor(index / columns)];
    for (let j = Math.max(0, row - cells); j <= Math.min(rows - 1, row + cells); j++)
      near.fill(1, j * columns + Math.max(0, column - cells), j * columns + Math.min(columns - 1, column + cells) + 1);
  }
  return near;
}
