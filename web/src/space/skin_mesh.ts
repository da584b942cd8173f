/** The skin as a thin sheet. */

import { BufferAttribute, BufferGeometry, DoubleSide, Mesh, MeshLambertMaterial } from "three";

import type { Skin } from "../geometry/skin";

export function skinMesh(skin: Skin): Mesh<BufferGeometry, MeshLambertMaterial> {
  const { columns, rows } = skin;
  const positions = new Float32Array(3 * columns * rows);
  const indices: number[] = [];
  for (let row = 0; row < rows; row++)
    for (let column = 0; column < columns; column++) {
      const at = row * columns + column;
      positions.set(skin.corner(column, row), 3 * at);
      const square = [at, at + 1, at + columns, at + columns + 1] as const;
      if (column === columns - 1 || row === rows - 1 || square.some((corner) => !skin.near[corner])) continue;
      indices.push(square[0], square[1], square[2], square[2], square[1], square[3]);
    }
  const geometry = new BufferGeometry().setAttribute("position", new BufferAttribute(positions, 3));
  geometry.setIndex(indices);
  geometry.computeVertexNormals();
  const material = new MeshLambertMaterial({
    color: 0xd9a183,
    transparent: true,
    opacity: 0.22,
    side: DoubleSide,
    depthWrite: false,
  });
  return new Mesh(geometry, material);
}
