/** The planes of a sweep, translucent, with their outlines. */

import {
  BufferAttribute,
  BufferGeometry,
  DoubleSide,
  Group,
  InstancedMesh,
  LineBasicMaterial,
  LineSegments,
  MeshBasicMaterial,
  type Plane,
  Vector3,
} from "three";

import type { Line } from "../geometry/plane";
import type { Pose } from "../geometry/pose";
import { matrixOf } from "./place";
import { planeShape } from "./shapes";

const MOST_PLANES = 40; // more would only be a solid block
const COLOUR = 0x3d9ac4;

/** At most MOST_PLANES of the poses, evenly taken; `cut` leaves out what of the planes lies behind it.
 *
 * `filled`: whether they are more than outlines, which costs much where the processor draws.
 */
export function sweepPlanes(poses: readonly Pose[], lines: readonly Line[], cut: Plane, filled: boolean): Group {
  const step = Math.max(1, Math.ceil(poses.length / MOST_PLANES));
  const shown = poses.filter((_, index) => index % step === 0);
  const shape = planeShape(lines);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(shape.positions, 3));
  geometry.setIndex(shape.indices);
  const fill = new MeshBasicMaterial({
    color: COLOUR,
    transparent: true,
    opacity: 0.035,
    side: DoubleSide,
    depthWrite: false,
    clippingPlanes: [cut],
  });
  const planes = new InstancedMesh(geometry, fill, shown.length);
  planes.frustumCulled = false;
  const ends: number[] = [];
  for (const [index, pose] of shown.entries()) {
    const matrix = matrixOf(pose);
    planes.setMatrixAt(index, matrix);
    for (const corner of shape.outline)
      ends.push(...new Vector3().fromArray(shape.positions, corner * 3).applyMatrix4(matrix).toArray());
  }
  const outlines = new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(ends), 3));
  const stroke = new LineBasicMaterial({ color: COLOUR, transparent: true, opacity: 0.28 });
  planes.visible = filled;
  return new Group().add(planes, new LineSegments(outlines, stroke));
}
