/** The scene as a grid of voxels: what its Gaussians add up to, as docs/physics.md §3 adds them, without the way of sound. */

import type { Gaussians } from "../api/gaussians";
import type { Vector } from "../geometry/pose";

export interface Grid {
  /** The corner of the first voxel, mm. */
  low: Vector;
  voxel_mm: number;
  size: readonly [number, number, number];
}

/** Four bytes a voxel, x fastest: echo E = γ·I, coverage γ, what blocks the sound γ·(1 − τ), and the label. */
export interface Volume {
  grid: Grid;
  voxels: Uint8Array<ArrayBuffer>;
}

const REACH = 3; // standard deviations, as far as Gaussians count
const KEPT_SHARE = 0.001; // of the Gaussians may lie beside the box on each side: strays would make it coarse
const PASSING_SHARE = 0.004; // of the voxels are brighter than the end of the colours
const BLUR = 0.5; // standard deviation of a voxel, in voxels: none falls between their centres
const EXPONENTIALS = Float32Array.from({ length: 1024 }, (_, i) => Math.exp((-0.5 * REACH ** 2 * (i + 0.5)) / 1024));
const PER_Q = 1024 / REACH ** 2;

/** A grid around the Gaussians. */
export function gridAround(gaussians: Gaussians, voxel_mm: number): Grid {
  const ends = (["x", "y", "z"] as const).map((name) => {
    const sorted = gaussians.column(name).sort();
    const stray = Math.floor(KEPT_SHARE * sorted.length);
    return [(sorted[stray] ?? 0) - 1, (sorted[sorted.length - 1 - stray] ?? 0) + 1] as const;
  });
  const size = ends.map(([low, high]) => Math.max(1, Math.ceil((high - low) / voxel_mm)));
  return { low: ends.map(([low]) => low) as unknown as Vector, voxel_mm, size: size as unknown as Grid["size"] };
}

/** How many voxels the Gaussians touch together, about. */
export function workOf(gaussians: Gaussians, voxel_mm: number): number {
  const [a, b, c] = (["deviation_1_mm", "deviation_2_mm", "deviation_3_mm"] as const).map((name) => gaussians.column(name));
  const ball = (4 / 3) * Math.PI * REACH ** 3;
  let sum = 0;
  for (let i = 0; i < gaussians.count; i++) {
    const volume = [a!, b!, c!].reduce((product, deviations) => product * Math.hypot(deviations[i]! / voxel_mm, BLUR), 1);
    sum += ball * volume;
  }
  return sum;
}

/** Adds the Gaussians up. */
export function voxelise(gaussians: Gaussians, grid: Grid): Volume {
  const { low, voxel_mm, size } = grid;
  const count = size[0] * size[1] * size[2];
  const sums = (): Float32Array => new Float32Array(count);
  const [weights, echoes, blocks, votes] = [sums(), sums(), sums(), sums()];
  const labels = new Uint8Array(count);
  const intensity = gaussians.column("intensity");
  const transmittance = gaussians.column("transmittance");
  const label = gaussians.column("label");
  const share = gaussians.total / Math.max(1, gaussians.count);
  const centres = (["x", "y", "z"] as const).map((name) => gaussians.column(name));
  const covariances = covariancesOf(gaussians);
  for (let i = 0; i < gaussians.count; i++) {
    const [x, y, z] = centres.map((column, k) => (column[i]! - low[k]!) / voxel_mm - 0.5) as [number, number, number];
    const scaled = covariances.subarray(6 * i, 6 * i + 6).map((value) => value / voxel_mm ** 2);
    const sharp = determinant(scaled);
    for (const k of [0, 3, 5]) scaled[k]! += BLUR ** 2;
    const blurred = determinant(scaled);
    const peak = share * Math.sqrt(Math.max(0, sharp) / blurred);
    const [xx, xy, xz, yy, yz, zz] = inverse(scaled, blurred);
    const z1 = Math.min(size[2] - 1, Math.floor(z + REACH * Math.sqrt(scaled[5]!)));
    const y1 = Math.min(size[1] - 1, Math.floor(y + REACH * Math.sqrt(scaled[3]!)));
    for (let k = Math.max(0, Math.ceil(z - REACH * Math.sqrt(scaled[5]!))); k <= z1; k++)
      for (let j = Math.max(0, Math.ceil(y - REACH * Math.sqrt(scaled[3]!))); j <= y1; j++) {
        const [dy, dz] = [j - y, k - z];
        const b = (xy * dy + xz * dz) / xx;
        const rest = yy * dy * dy + 2 * yz * dy * dz + zz * dz * dz - b * b * xx; // q where it is least along x
        if (rest >= REACH ** 2) continue;
        const half = Math.sqrt((REACH ** 2 - rest) / xx);
        const row = (k * size[1] + j) * size[0];
        const last = Math.min(size[0] - 1, Math.floor(x - b + half));
        for (let at = Math.max(0, Math.ceil(x - b - half)); at <= last; at++) {
          const dx = at - x + b;
          const weight = peak * EXPONENTIALS[Math.min(1023, ((rest + xx * dx * dx) * PER_Q) | 0)]!;
          const voxel = row + at;
          weights[voxel]! += weight;
          echoes[voxel]! += weight * intensity[i]!;
          blocks[voxel]! += weight * (1 - transmittance[i]!);
          // the label that most of the weight votes for, in one pass
          if (labels[voxel] === label[i]) votes[voxel]! += weight;
          else if ((votes[voxel]! -= weight) < 0) {
            labels[voxel] = label[i]!;
            votes[voxel] = -votes[voxel]!;
          }
        }
      }
  }
  const voxels = new Uint8Array(4 * count);
  for (let voxel = 0; voxel < count; voxel++) {
    const sum = weights[voxel]!;
    if (sum === 0) continue;
    const coverage = 255 * -Math.expm1(-sum);
    voxels[4 * voxel] = (coverage * echoes[voxel]!) / sum;
    voxels[4 * voxel + 1] = coverage;
    voxels[4 * voxel + 2] = (coverage * blocks[voxel]!) / sum;
    voxels[4 * voxel + 3] = labels[voxel]!;
  }
  return { grid, voxels };
}

/** The echo that only a few voxels pass, as a share: where the colours end. */
export function brightestOf({ voxels }: Volume): number {
  const counts = new Uint32Array(256);
  for (let at = 0; at < voxels.length; at += 4) counts[voxels[at]!]! += 1;
  counts[0] = 0;
  const all = counts.reduce((sum, count) => sum + count, 0);
  let above = 0;
  for (let value = 255; value > 0; value--) if ((above += counts[value]!) > PASSING_SHARE * all) return value / 255;
  return 1;
}

const SMALL_SHARE = 0.05; // of what is labelled
const MOST_SHADOW = 0.1;
const COVERED = 64;

/** The labels of small things that let sound pass, such as vessels: they hide nothing, and casting no shadow they would stay unseen. */
export function smallLabels({ voxels }: Volume): number[] {
  const sums = Array.from({ length: 256 }, () => ({ coverage: 0, shadow: 0 }));
  for (let at = 0; at < voxels.length; at += 4) {
    if (voxels[at + 3] === 0 || voxels[at + 1]! < COVERED) continue;
    const sum = sums[voxels[at + 3]!]!;
    sum.coverage += voxels[at + 1]!;
    sum.shadow += voxels[at + 2]!;
  }
  const all = sums.reduce((sum, { coverage }) => sum + coverage, 0);
  return sums.flatMap(({ coverage, shadow }, label) => (coverage < SMALL_SHARE * all && shadow < MOST_SHADOW * coverage ? [label] : []));
}

/** The byte of a channel of the voxel that holds a point; 0 outside. */
export function byteAt({ grid: { low, voxel_mm, size }, voxels }: Volume, x: number, y: number, z: number, channel: number): number {
  const [i, j, k] = [x, y, z].map((value, axis) => Math.floor((value - low[axis]!) / voxel_mm)) as [number, number, number];
  if (i < 0 || j < 0 || k < 0 || i >= size[0] || j >= size[1] || k >= size[2]) return 0;
  return voxels[4 * ((k * size[1] + j) * size[0] + i) + channel]!;
}

/** xx, xy, xz, yy, yz, zz of each Gaussian in the scene's axes, mm². */
export function covariancesOf(gaussians: Gaussians): Float32Array {
  const [w, x, y, z, a, b, c] = (
    ["qw", "qx", "qy", "qz", "deviation_1_mm", "deviation_2_mm", "deviation_3_mm"] as const
  ).map((name) => gaussians.column(name)) as Float32Array[];
  const covariances = new Float32Array(6 * gaussians.count);
  for (let i = 0; i < gaussians.count; i++) {
    const [qw, qx, qy, qz] = [w![i]!, x![i]!, y![i]!, z![i]!];
    const [s0, s1, s2] = [a![i]! ** 2, b![i]! ** 2, c![i]! ** 2];
    const rows = [
      [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)],
      [2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx)],
      [2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)],
    ] as const;
    let at = 6 * i;
    for (let p = 0; p < 3; p++)
      for (let q = p; q < 3; q++)
        covariances[at++] = s0 * rows[p]![0] * rows[q]![0] + s1 * rows[p]![1] * rows[q]![1] + s2 * rows[p]![2] * rows[q]![2];
  }
  return covariances;
}

function determinant([xx, xy, xz, yy, yz, zz]: Float32Array): number {
  return xx! * (yy! * zz! - yz! * yz!) - xy! * (xy! * zz! - yz! * xz!) + xz! * (xy! * yz! - yy! * xz!);
}

function inverse(given: Float32Array, by: number): [number, number, number, number, number, number] {
  const [xx, xy, xz, yy, yz, zz] = Array.from(given) as [number, number, number, number, number, number];
  return [
    (yy * zz - yz * yz) / by,
    (xz * yz - xy * zz) / by,
    (xy * yz - xz * yy) / by,
    (xx * zz - xz * xz) / by,
    (xy * xz - xx * yz) / by,
    (xx * yy - xy * xy) / by,
  ];
}
