/** Poses from numbers that somebody wrote, checked as the service checks them. */

import { entry, fromPositionQuaternion, position, quaternion, type Pose, type Quaternion, type Vector } from "./pose";
import { PoseError } from "./pose_faults";

const ROTATION_TOLERANCE = 1e-3; // as of the service
const LENGTH_TOLERANCE = 1e-2;

/** Where numbers stand, for errors. */
export interface Where {
  line?: number;
  pose?: number;
}

/** The pose of 12 or 16 numbers, row by row. */
export function poseOfMatrix(numbers: readonly number[], where: Where = {}): Pose {
  const pose = numbers.length === 12 ? [...numbers, 0, 0, 0, 1] : numbers;
  if (pose.length !== 16) throw fault({ kind: "count", found: numbers.length, expected: "12, 16" }, where);
  const last = [0, 0, 0, 1].some((expected, column) => Math.abs(entry(pose, 3, column) - expected) > ROTATION_TOLERANCE);
  if (last) throw fault({ kind: "lastRow" }, where);
  if (rotationError(pose) > ROTATION_TOLERANCE) throw fault({ kind: "rotation", mirrors: false }, where);
  if (determinant(pose) < 0) throw fault({ kind: "rotation", mirrors: true }, where);
  return fromPositionQuaternion(position(pose), quaternion(pose));
}

/** The pose of a place and a quaternion w, x, y, z. */
export function poseOfQuaternion(place: Vector, rotation: Quaternion, where: Where = {}): Pose {
  const length = Math.hypot(...rotation);
  if (Math.abs(length - 1) > LENGTH_TOLERANCE) throw fault({ kind: "quaternion", length }, where);
  return fromPositionQuaternion(place, rotation);
}

/** A number as it is written. */
export function numberOf(text: string, where: Where = {}): number {
  const number = Number(text);
  if (text.trim() === "" || !Number.isFinite(number)) throw fault({ kind: "number", text: text.slice(0, 40) }, where);
  return number;
}

export function fault(what: ConstructorParameters<typeof PoseError>[0], { line, pose }: Where = {}): PoseError {
  return new PoseError(what, line ?? null, pose ?? null);
}

/** The largest entry of RᵀR − 1. */
function rotationError(pose: Pose): number {
  let largest = 0;
  for (let a = 0; a < 3; a++)
    for (let b = 0; b < 3; b++) {
      const product = [0, 1, 2].reduce((sum, row) => sum + entry(pose, row, a) * entry(pose, row, b), 0);
      largest = Math.max(largest, Math.abs(product - (a === b ? 1 : 0)));
    }
  return Number.isFinite(largest) ? largest : Infinity;
}

function determinant(pose: Pose): number {
  const m = (row: number, column: number): number => entry(pose, row, column);
  return (
    m(0, 0) * (m(1, 1) * m(2, 2) - m(1, 2) * m(2, 1)) -
    m(0, 1) * (m(1, 0) * m(2, 2) - m(1, 2) * m(2, 0)) +
    m(0, 2) * (m(1, 0) * m(2, 1) - m(1, 1) * m(2, 0))
  );
}
