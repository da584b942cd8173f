/** Poses for three.js. */

import { Matrix4, type Object3D } from "three";

import type { Pose } from "../geometry/pose";

/** The pose as a matrix of three.js. */
export function matrixOf(pose: Pose): Matrix4 {
  return new Matrix4().set(...(pose as Parameters<Matrix4["set"]>));
}

/** Puts an object where a probe of that pose is. */
export function placeObject(object: Object3D, pose: Pose): void {
  const matrix = matrixOf(pose);
  object.position.setFromMatrixPosition(matrix);
  object.quaternion.setFromRotationMatrix(matrix);
}
