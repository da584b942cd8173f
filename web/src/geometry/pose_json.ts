/** Poses as the JSON that the service and its command line write and read. */

import { position, quaternion, type Pose, type Vector } from "./pose";
import { fault, poseOfMatrix, poseOfQuaternion, type Where } from "./pose_checks";

const MOST_POSES = 100_000;

/** The pose as the JSON object that the service reads. */
export function poseJson(pose: Pose): string {
  const round = (value: number, digits: number): number => Number(value.toFixed(digits));
  const [x, y, z] = position(pose).map((value) => round(value, 3));
  const [w, i, j, k] = quaternion(pose).map((value) => round(value, 6));
  return JSON.stringify({ position_mm: { x, y, z }, quaternion: { w, x: i, y: j, z: k } });
}

/** The pose of such an object, or of one with a `matrix`. Throws PoseError. */
export function poseFromJson(text: string): Pose {
  return poseOf(parsed(text));
}

/** One or more poses: such objects or matrices of three or four rows, in a list or under `poses`. Throws PoseError. */
export function posesFromJson(text: string): Pose[] {
  const document = parsed(text);
  const given = isObject(document) && "poses" in document ? document.poses : document;
  const list = Array.isArray(given) && !isMatrix(given) ? (given as unknown[]) : [given];
  requireCount(list.length);
  return list.map((one, index) => poseOf(one, list.length > 1 ? { pose: index + 1 } : {}));
}

/** Seconds of each pose under `times_s`; null where there are none. */
export function timesFromJson(text: string): number[] | null {
  const document = parsed(text);
  const times = isObject(document) ? document.times_s : null;
  return Array.isArray(times) && times.every(Number.isFinite) ? (times as number[]) : null;
}

/** Throws PoseError for none, and for more than one file may have. */
export function requireCount(count: number): void {
  if (count === 0) throw fault({ kind: "empty" });
  if (count > MOST_POSES) throw fault({ kind: "tooMany", count, most: MOST_POSES });
}

function parsed(text: string): unknown {
  try {
    return JSON.parse(text);
  } catch (error) {
    throw fault({ kind: "json", problem: error instanceof Error ? error.message : "" });
  }
}

function poseOf(given: unknown, where: Where = {}): Pose {
  if (Array.isArray(given)) return poseOfMatrix(numbersIn(given), where);
  if (!isObject(given)) throw fault({ kind: "json", problem: "position_mm, quaternion" }, where);
  if (given.matrix !== undefined) return poseOfMatrix(numbersIn(given.matrix), where);
  const place = numbersOf(given, "position_mm", ["x", "y", "z"], where);
  const [w, x, y, z] = numbersOf(given, "quaternion", ["w", "x", "y", "z"], where) as [number, number, number, number];
  return poseOfQuaternion(place as unknown as Vector, [w, x, y, z], where);
}

function numbersIn(given: unknown): number[] {
  const numbers = Array.isArray(given) ? (given.flat() as unknown[]) : [];
  return numbers.every(Number.isFinite) ? (numbers as number[]) : [];
}

/** Whether a list is one matrix, and not a list of poses. */
function isMatrix(list: unknown[]): boolean {
  const rows = list.every((row) => Array.isArray(row) && row.length === 4 && row.every(Number.isFinite));
  return rows && (list.length === 3 || list.length === 4);
}

function isObject(value: unknown): value is Record<string, unknown> {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function numbersOf(given: Record<string, unknown>, key: string, names: string[], where: Where): number[] {
  const value = given[key];
  const numbers = names.map((name) => (isObject(value) ? value[name] : undefined));
  if (!numbers.every((number) => typeof number === "number" && Number.isFinite(number)))
    throw fault({ kind: "jsonNumbers", key, names }, where);
  return numbers as number[];
}

