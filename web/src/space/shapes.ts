/** The image plane of a probe as triangles and as an outline, in the probe frame, in mm. */

import type { Probe } from "../api/scenes";
import { nearDepth_mm, pixelAt, type Placed } from "../geometry/picture";

export interface Shape {
  /** x, y, z of each corner. */
  positions: Float32Array;
  /** Triangles. */
  indices: number[];
  /** Pairs of corners. */
  outline: number[];
}

const FAN_STRIPS = 32;

/** A strip from near to far with `FAN_STRIPS` pieces; of a linear probe one rectangle. */
export function planeShape(probe: Probe): Shape {
  const strips = probe.kind === "linear" ? 1 : FAN_STRIPS;
  const near = nearDepth_mm(probe);
  const positions: number[] = [];
  const indices: number[] = [];
  const outline: number[] = [0, 1, strips * 2, strips * 2 + 1];
  for (let strip = 0; strip <= strips; strip++) {
    const share = strip / strips - 0.5;
    for (const depth of [near, probe.far_mm]) positions.push(...pointOn(probe, share, depth));
    if (strip === strips) break;
    const first = strip * 2;
    indices.push(first, first + 1, first + 2, first + 2, first + 1, first + 3);
    outline.push(first, first + 2, first + 1, first + 3);
  }
  return { positions: new Float32Array(positions), indices, outline };
}

function pointOn(probe: Probe, share: number, depth: number): [number, number, number] {
  if (probe.kind === "linear") return [probe.width_mm * share, 0, depth];
  const angle = (probe.opening_angle_deg / 180) * Math.PI * share;
  return [depth * Math.sin(angle), 0, depth * Math.cos(angle)];
}

/** Where each corner lies in the texture of a picture, 0 to 1, the first row at v = 0. */
export function textureCoordinates({ positions }: Shape, placed: Placed): Float32Array {
  const coordinates = new Float32Array((positions.length / 3) * 2);
  for (let corner = 0; corner < positions.length / 3; corner++) {
    const point = { x_mm: positions[corner * 3]!, z_mm: positions[corner * 3 + 2]! };
    const { column, row } = pixelAt(placed, point);
    coordinates[corner * 2] = (column + 0.5) / placed.width;
    coordinates[corner * 2 + 1] = (row + 0.5) / placed.height;
  }
  return coordinates;
}
