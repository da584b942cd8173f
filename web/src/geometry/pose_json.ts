/** Poses as the service and its command line write and read them. Every reader throws an Error in words. */

import { entry, fromPositionQuaternion, position, quaternion, type Pose, type Vector } from "./pose";

const ROTATION_TOLERANCE = 1e-3; // as of the service
const MOST_POSES = 100_000;

/** The pose as the JSON object that the service reads. */
export function poseJson(pose: Pose): string {
  const round = (value: number, digits: number): number => Number(value.toFixed(digits));
  const [x, y, z] = position(pose).map((value) => round(value, 3));
  const [w, i, j, k] = quaternion(pose).map((value) => round(value, 6));
  return JSON.stringify({ position_mm: { x, y, z }, quaternion: { w, x: i, y: j, z: k } });
}

/** The pose of such an object, or of one with a `matrix`. */
export function poseFromJson(text: string): Pose {
  return poseOf(parsed(text), "");
}

/** One or more poses of a file: such objects or matrices of three or four rows, in a list or under `poses`. */
export function posesFromJson(text: string): Pose[] {
  const document = parsed(text);
  const given = isObject(document) && "poses" in document ? document.poses : document;
  const list = Array.isArray(given) && !isMatrix(given) ? (given as unknown[]) : [given];
  if (list.length === 0) throw new Error("There are no poses in it.");
  if (list.length > MOST_POSES) throw new Error(`There may be at most ${MOST_POSES} poses, and these are ${list.length}.`);
  return list.map((one, index) => poseOf(one, list.length > 1 ? `Pose ${index + 1}: ` : ""));
}

function parsed(text: string): unknown {
  try {
    return JSON.parse(text);
  } catch {
    throw new Error("This is not JSON.");
  }
}

function poseOf(given: unknown, where: string): Pose {
  if (Array.isArray(given)) return poseOfMatrix(given, `${where}a pose`);
  if (!isObject(given)) throw new Error(`${where}a pose is an object of position_mm and quaternion, or of matrix.`);
  if (given.matrix !== undefined) return poseOfMatrix(given.matrix, `${where}matrix`);
  const p = numbersOf(given.position_mm, ["x", "y", "z"], `${where}position_mm`);
  const q = numbersOf(given.quaternion, ["w", "x", "y", "z"], `${where}quaternion`);
  if (Math.abs(Math.hypot(...q) - 1) > 1e-2) throw new Error(`${where}quaternion must have length 1.`);
  return fromPositionQuaternion(p as unknown as Vector, q as unknown as [number, number, number, number]);
}

function poseOfMatrix(given: unknown, what: string): Pose {
  const numbers = Array.isArray(given) ? (given.flat() as unknown[]) : [];
  if (numbers.length === 12) numbers.push(0, 0, 0, 1);
  if (numbers.length !== 16 || !numbers.every(Number.isFinite)) throw new Error(`${what} needs four rows of four numbers.`);
  const pose = numbers as number[];
  if ([0, 0, 0, 1].some((expected, column) => Math.abs(entry(pose, 3, column) - expected) > ROTATION_TOLERANCE))
    throw new Error(`${what} must end in the row 0 0 0 1; the translation is its last column.`);
  if (rotationError(pose) > ROTATION_TOLERANCE) throw new Error(`${what} must hold a rotation: its axes have length 1 and are square.`);
  if (determinant(pose) < 0) throw new Error(`${what} must hold a rotation: this one mirrors.`);
  return fromPositionQuaternion(position(pose), quaternion(pose));
}

/** The largest entry of RᵀR − 1. */
function rotationError(pose: Pose): number {
  let largest = 0;
  for (let a = 0; a < 3; a++)
    for (let b = 0; b < 3; b++) {
      const product = [0, 1, 2].reduce((sum, row) => sum + entry(pose, row, a) * entry(pose, row, b), 0);
      largest = Math.max(largest, Math.abs(product - (a === b ? 1 : 0)));
    }
  return largest;
}

function determinant(pose: Pose): number {
  const m = (row: number, column: number): number => entry(pose, row, column);
  return (
    m(0, 0) * (m(1, 1) * m(2, 2) - m(1, 2) * m(2, 1)) -
    m(0, 1) * (m(1, 0) * m(2, 2) - m(1, 2) * m(2, 0)) +
    m(0, 2) * (m(1, 0) * m(2, 1) - m(1, 1) * m(2, 0))
  );
}

/** Whether a list is one matrix, and not a list of poses. */
function isMatrix(list: unknown[]): boolean {
  const rows = list.every((row) => Array.isArray(row) && row.length === 4 && row.every(Number.isFinite));
  return rows && (list.length === 3 || list.length === 4);
}

function isObject(value: unknown): value is Record<string, unknown> {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function numbersOf(value: unknown, names: string[], what: string): number[] {
  const numbers = names.map((name) => (isObject(value) ? value[name] : undefined));
  if (!numbers.every((number) => typeof number === "number" && Number.isFinite(number)))
    throw new Error(`${what} needs the numbers ${names.join(", ")}.`);
  return numbers as number[];
}
