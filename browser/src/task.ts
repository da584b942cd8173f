/** Tasks for trainees and their scores: pure functions of where the probe was, when, and of its frames.
 *
 * The words are those of the gymnasium environment "scan to a standard plane" (docs/howto/gymnasium.md): how far the
 * middle of the face is off the target's (`distance_mm`), the angle of the turn, similarity, contact, and the reward.
 */

import { angle_deg, apply, entry, length, minus, plus, type Pose, position, scaled, type Vector } from "./pose.js";
import type { Frame, SceneInfo } from "./scene.js";

type Probe = NonNullable<SceneInfo["probe"]>;

export interface Task {
  probe: Probe;
  /** The pose of the standard plane, and how near to it is near enough. */
  target: Pose;
  reached_mm?: number;
  reached_deg?: number;
  /** Points of the scene, mm, that are to be seen; seen is what lies in the image, at most `slice_mm` beside its plane. */
  region?: readonly Vector[];
  slice_mm?: number;
}

/** Where the probe was at a time, and what its frame told there. */
export interface Moment {
  time_s: number;
  pose: Pose;
  /** To the frame of the target; see `similarity`. */
  similarity?: number;
  /** Of the scan lines; left out where contact is not judged. */
  contact_share?: number | null;
}

/** Up to the moment at which the target was reached; where it was not, of the whole run. */
export interface Score {
  reached: boolean;
  time_s: number;
  /** Off the target at the end. */
  distance_mm: number;
  angle_deg: number;
  /** The way of the middle of the face, and all turns added up. */
  path_mm: number;
  path_deg: number;
  /** The log dimensionless jerk: about −5 for one smooth reach, less the more a hand starts and stops. null: no change of speed. */
  smoothness: number | null;
  /** The share of the region that was seen, and the share of contact over the time. null: without a region, or contact. */
  coverage: number | null;
  contact_share: number | null;
  /** (similarity − 1) + (contact_share − 1) at the end: 0 at best. null: without similarity. */
  reward: number | null;
}

const LEAST_CONTACT = 0.9; // without which a target is not reached
const RATE_HZ = 10; // at which jerk is taken: faster than a hand steers, slower than it shakes
const COARSE = 8; // pixels of a side that are averaged

/** The score of a run. Throws for one without moments, and for times that do not rise. */
export function score(task: Task, run: readonly Moment[]): Score {
  if (run.length === 0) throw new Error("a run must have at least one moment, got none");
  if (run.some(({ time_s }, at) => at > 0 && !(time_s > run[at - 1]!.time_s))) throw new Error("the times of a run must rise from moment to moment");
  const first = run.findIndex((moment) => isReached(task, moment));
  const moments = run.slice(0, first < 0 ? run.length : first + 1);
  const [begin, end] = [moments[0]!, moments.at(-1)!];
  const steps = moments.slice(1).map((moment, at) => [moments[at]!, moment] as const);
  const sum = (of: (before: Moment, after: Moment) => number): number => steps.reduce((all, [before, after]) => all + of(before, after), 0);
  const time_s = end.time_s - begin.time_s;
  const isJudged = moments.every(({ contact_share }) => typeof contact_share === "number");
  const touched_s = sum((before, after) => ((before.contact_share! + after.contact_share!) / 2) * (after.time_s - before.time_s));
  const seen = task.region?.filter((point) => moments.some(({ pose }) => isSeen(task, pose, point)));
  return {
    reached: first >= 0,
    time_s,
    ...offTarget(task, end.pose),
    path_mm: sum((before, after) => length(minus(faceOf(task.probe, after.pose), faceOf(task.probe, before.pose)))),
    path_deg: sum((before, after) => angle_deg(before.pose, after.pose)),
    smoothness: smoothness(moments.map(({ time_s, pose }) => ({ time_s, at: faceOf(task.probe, pose) }))),
    coverage: seen === undefined || task.region!.length === 0 ? null : seen.length / task.region!.length,
    contact_share: !isJudged ? null : time_s > 0 ? touched_s / time_s : end.contact_share!,
    reward: end.similarity === undefined ? null : end.similarity - 1 + ((end.contact_share ?? 1) - 1),
  };
}

/** How far a pose is off the target: the middle of the face in mm, the turn in degrees. */
export function offTarget({ probe, target }: Task, pose: Pose): { distance_mm: number; angle_deg: number } {
  return { distance_mm: length(minus(faceOf(probe, pose), faceOf(probe, target))), angle_deg: angle_deg(pose, target) };
}

export function isReached(task: Task, { pose, contact_share }: Moment): boolean {
  const off = offTarget(task, pose);
  return off.distance_mm <= (task.reached_mm ?? 1) && off.angle_deg <= (task.reached_deg ?? 2) && (contact_share ?? 1) >= LEAST_CONTACT;
}

/** The mean of two correlations, from −1 to 1: of two frames of one size, and of their means over 8x8 pixels. */
export function similarity(one: Frame, other: Frame): number {
  const { height, width } = one.info;
  if (other.info.height !== height || other.info.width !== width)
    throw new Error(`frames must have one size, got ${height}x${width} and ${other.info.height}x${other.info.width}`);
  const [here, there] = [one, other].map((frame) => Float64Array.from(frame.pixels())) as [Float64Array, Float64Array];
  const fine = correlation(here, there);
  return Math.min(1, (fine + correlation(coarse(here, height, width), coarse(there, height, width))) / 2);
}

/** The middle of the face in the scene: of a convex probe, whose origin is the apex of its fan, `near_mm` down the axis. */
function faceOf(probe: Probe, pose: Pose): Vector {
  return apply(pose, [0, 0, probe.kind === "convex" ? probe.near_mm : 0]);
}

function isSeen({ probe, slice_mm = 2 }: Task, pose: Pose, point: Vector): boolean {
  const way = minus(point, position(pose));
  const [x, y, z] = [0, 1, 2].map((axis) => way.reduce((sum, one, row) => sum + one * entry(pose, row, axis), 0)) as [number, number, number];
  return Math.abs(y) <= slice_mm && isInImage(probe, x, z);
}

/** Whether a scan line goes through a point of the image plane. */
function isInImage(probe: Probe, x: number, z: number): boolean {
  const within = (depth: number, near: number): boolean => depth >= near && depth <= probe.far_mm;
  const turned_deg = (Math.abs(Math.atan2(x, z)) * 180) / Math.PI;
  switch (probe.kind) {
    case "linear":
      return Math.abs(x) <= probe.width_mm / 2 && within(z, probe.near_mm);
    case "steered": {
      const steering = (probe.steering_deg * Math.PI) / 180;
      return Math.abs(x - z * Math.tan(steering)) <= probe.width_mm / 2 && within(z / Math.cos(steering), probe.near_mm);
    }
    case "convex":
    case "phased":
      return turned_deg <= probe.opening_angle_deg / 2 && within(Math.hypot(x, z), "near_mm" in probe ? probe.near_mm : 0);
    case "radial":
      return within(Math.hypot(x, z), probe.near_mm);
  }
}

/** −ln(T³ / v² · ∫|jerk|² dt), T the time and v the greatest speed: it tells neither how far nor how fast a hand went. */
function smoothness(track: readonly { time_s: number; at: Vector }[]): number | null {
  const [begin_s, time_s] = [track[0]!.time_s, track.at(-1)!.time_s - track[0]!.time_s];
  let k = 0;
  const places = Array.from({ length: Math.floor(time_s * RATE_HZ) + 1 }, (_, number) => {
    const now_s = begin_s + number / RATE_HZ;
    while (k < track.length - 2 && track[k + 1]!.time_s <= now_s) k += 1;
    const [before, after] = [track[k]!, track[k + 1] ?? track[k]!];
    const share = Math.min(1, (now_s - before.time_s) / (after.time_s - before.time_s || 1));
    return plus(before.at, scaled(minus(after.at, before.at), share));
  });
  const change = (values: readonly Vector[]): Vector[] => values.slice(1).map((value, at) => scaled(minus(value, values[at]!), RATE_HZ));
  const speeds = change(places);
  const fastest = Math.max(0, ...speeds.map(length));
  const jerk = change(change(speeds)).reduce((sum, one) => sum + length(one) ** 2 / RATE_HZ, 0);
  return fastest > 0 && jerk > 0 ? -Math.log((time_s ** 3 / fastest ** 2) * jerk) : null;
}

/** That of a frame without contrast, such as one without contact, is 0. */
function correlation(one: Float64Array, other: Float64Array): number {
  const [a, b] = [one, other].map((values) => {
    const mean = values.reduce((sum, value) => sum + value, 0) / values.length;
    return values.map((value) => value - mean);
  }) as [Float64Array, Float64Array];
  const product = (x: Float64Array, y: Float64Array): number => x.reduce((sum, value, at) => sum + value * y[at]!, 0);
  const size = Math.sqrt(product(a, a) * product(b, b));
  return size > 0 ? product(a, b) / size : 0;
}

function coarse(pixels: Float64Array, height: number, width: number): Float64Array {
  const [rows, columns] = [height, width].map((side) => Math.max(1, Math.floor(side / COARSE))) as [number, number];
  const [sums, counts] = [new Float64Array(rows * columns), new Float64Array(rows * columns)];
  pixels.forEach((value, at) => {
    const row = Math.floor((Math.floor(at / width) * rows) / height);
    const cell = row * columns + Math.floor(((at % width) * columns) / width);
    sums[cell]! += value;
    counts[cell]! += 1;
  });
  return sums.map((sum, cell) => sum / counts[cell]!);
}
