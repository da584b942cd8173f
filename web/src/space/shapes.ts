/** The image plane of a probe as triangles and as an outline, in the probe frame, in mm. */

import { pixelAt, type Placed } from "../geometry/picture";
import { areAllAround, type Line } from "../geometry/plane";

export interface Shape {
  /** x, y, z of each corner: of each line, where it begins and where it ends. */
  positions: Float32Array;
  /** Triangles. */
  indices: number[];
  /** Pairs of corners. */
  outline: number[];
}

export function planeShape(lines: readonly Line[]): Shape {
  const last = 2 * (lines.length - 1);
  const indices: number[] = [];
  const outline: number[] = areAllAround(lines) ? [] : [0, 1, last, last + 1];
  for (let first = 0; first < last; first += 2) {
    indices.push(first, first + 1, first + 2, first + 2, first + 1, first + 3);
    outline.push(first, first + 2, first + 1, first + 3);
  }
  const positions = new Float32Array(lines.flatMap(([x0, z0, x1, z1]) => [x0, 0, z0, x1, 0, z1]));
  return { positions, indices, outline };
}

/** Where each corner of the plane of a picture lies in its texture, 0 to 1, the first row at v = 0. */
export function textureCoordinates(placed: Placed): Float32Array {
  const { lines, width, height, picture, isStored } = placed;
  const corners = lines.flatMap(([x0, z0, x1, z1], index) => {
    if (isStored) {
      const share = index / (lines.length - 1);
      const u = picture.step[0] < 0 ? 1 - share : share;
      return [u, 0, u, 1];
    }
    return [{ x_mm: x0, z_mm: z0 }, { x_mm: x1, z_mm: z1 }].flatMap((end) => {
      const { column, row } = pixelAt(placed, end);
      return [(column + 0.5) / width, (row + 0.5) / height];
    });
  });
  return new Float32Array(corners);
}
