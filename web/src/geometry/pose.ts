/** Vectors and rigid transforms: poses lead from the probe to the scene, as 16 numbers row by row, translation in mm. */

import {
  angle_deg, apply, DEGREES, distance_mm, entry, fromPositionQuaternion, IDENTITY, length, minus, multiply, orientationFrom, plus, type Pose,
  position, type Quaternion, quaternion, scaled, translated, type Vector, withPosition,
} from "../../../browser/src/pose";
import type { Registration } from "../api/scenes";

export * from "../../../browser/src/pose";

const UPRIGHT = 1 - 1e-10; // sine of a rock at which tilt and rotation are one turn, told as rotation

export const dot = (a: Vector, b: Vector): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** Of length 1; nothing stays nothing. */
export const unit = (a: Vector): Vector => scaled(a, 1 / (length(a) || 1));
export const cross = (a: Vector, b: Vector): Vector => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];

/** Where an arrow key leads on a screen: to the right, and down. */
export const ARROWS: Readonly<Record<string, readonly [number, number]>> = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, -1],
  ArrowDown: [0, 1],
};
/** A vector with one of its numbers in place of another. */
export function replaced(vector: readonly number[], index: number, value: number): [number, number, number] {
  return vector.map((before, i) => (i === index ? value : before)) as [number, number, number];
}

/** The direction of an axis of the probe (0 lateral, 1 elevation, 2 axial) in the scene. */
export function axis(pose: Pose, column: 0 | 1 | 2): Vector {
  return [entry(pose, 0, column), entry(pose, 1, column), entry(pose, 2, column)];
}

/** The rigid transform that leads back. */
export function inverse(pose: Pose): Pose {
  const back = fromPositionQuaternion([0, 0, 0], conjugate(quaternion(pose)));
  const [x, y, z] = apply(back, position(pose));
  return withPosition(back, [-x, -y, -z]);
}

/** First `inner`, then `outer`. */
export function composed(outer: Pose, inner: Pose): Pose {
  const turn = fromPositionQuaternion([0, 0, 0], multiply(quaternion(outer), quaternion(inner)));
  return withPosition(turn, apply(outer, position(inner)));
}

export function conjugate([w, x, y, z]: Quaternion): Quaternion {
  return [w, -x, -y, -z];
}

/** Tilt (about the lateral axis), rock (elevation), rotation (axial) of a pose against `home`, in degrees. */
export function anglesFrom(home: Pose, pose: Pose): Vector {
  const r = fromPositionQuaternion([0, 0, 0], multiply(conjugate(quaternion(home)), quaternion(pose)));
  // r = Rz(rotation) Ry(rock) Rx(tilt)
  const rock = -entry(r, 2, 0);
  if (Math.abs(rock) > UPRIGHT) return [0, Math.sign(rock) * 90, Math.atan2(-entry(r, 0, 1), entry(r, 1, 1)) * DEGREES];
  return [
    Math.atan2(entry(r, 2, 1), entry(r, 2, 2)) * DEGREES,
    Math.asin(Math.max(-1, Math.min(1, -entry(r, 2, 0)))) * DEGREES,
    Math.atan2(entry(r, 1, 0), entry(r, 0, 0)) * DEGREES,
  ];
}

/** The pose a share of the way from one to another. */
export function between(a: Pose, b: Pose, share: number): Pose {
  const place = plus(scaled(position(a), 1 - share), scaled(position(b), share));
  const from = quaternion(a);
  const to = quaternion(b);
  const dot = from[0] * to[0] + from[1] * to[1] + from[2] * to[2] + from[3] * to[3];
  const angle = Math.acos(Math.min(1, Math.abs(dot)));
  // slerp, the shorter way; of neighbours in a sweep the chord is as good as the arc
  const [kept, taken] = angle < 1e-3 ? [1 - share, share] : [Math.sin((1 - share) * angle), Math.sin(share * angle)];
  const blended = from.map((value, i) => kept * value + Math.sign(dot || 1) * taken * to[i]!) as unknown as Quaternion;
  return fromPositionQuaternion(place, blended);
}

/** Poses on a smooth path through others, `steps` from each to the next: positions on a Catmull-Rom spline, orientations by slerp. */
export function smoothPath(through: readonly Pose[], steps: number): Pose[] {
  const last = through.length - 1;
  const at = (place: number): Vector => position(through[Math.max(0, Math.min(last, place))]!);
  return Array.from({ length: last * steps + 1 }, (_, number) => {
    const place = Math.min(last - 1, Math.floor(number / steps));
    const t = number / steps - place;
    const weights = [t * (t * (2 - t) - 1), t * t * (3 * t - 5) + 2, t * (t * (4 - 3 * t) + 1), t * t * (t - 1)];
    const points = weights.map((_, i) => at(place - 1 + i));
    const along = (i: 0 | 1 | 2): number => weights.reduce((sum, weight, k) => sum + (weight * points[k]![i]) / 2, 0);
    return withPosition(between(through[place]!, through[place + 1]!, t), [along(0), along(1), along(2)]);
  });
}

/** The nearest of `poses`, a degree counting as a millimetre; -1 where there are none. */
export function nearest(poses: readonly Pose[], pose: Pose): number {
  let best = -1;
  let least = Infinity;
  for (const [index, other] of poses.entries()) {
    const away = distance_mm(other, pose) + angle_deg(other, pose);
    if (away < least) [best, least] = [index, away];
  }
  return best;
}

/** Where a pose lies on a track, in its poses and between them too; null where it is beside it. */
export function placeOn(track: readonly Pose[], pose: Pose): number | null {
  const index = nearest(track, pose);
  for (const start of [index - 1, index]) {
    const [from, to] = [track[start], track[start + 1]];
    if (from === undefined || to === undefined) continue;
    const whole_mm = distance_mm(from, to);
    const share = whole_mm === 0 ? 0 : Math.min(1, distance_mm(from, pose) / whole_mm);
    if (isSame(between(from, to, share), pose)) return start + share;
  }
  return index >= 0 && isSame(track[index]!, pose) ? index : null;
}

/** Whether two poses differ by no more than what is lost in writing them. */
function isSame(a: Pose, b: Pose): boolean {
  return distance_mm(a, b) < 0.01 && angle_deg(a, b) < 0.01;
}

/**
 * absolute: against the scene's origin and axes. relativeScene: the way from another pose along the scene's axes, and the
 * turn against it. relativeProbe: the same way along that pose's own lateral, elevation and axial axes.
 */
export const REFERENCES = ["absolute", "relativeScene", "relativeProbe"] as const;
export type Reference = (typeof REFERENCES)[number];

/** Tilt, rock and rotate in degrees, as `anglesFrom` has them. */
export interface Place {
  position_mm: Vector;
  angles_deg: Vector;
}

export function placeIn(pose: Pose, reference: Reference, other: Pose): Place {
  if (reference === "absolute") return { position_mm: position(pose), angles_deg: anglesFrom(IDENTITY, pose) };
  const [p, q] = [position(pose), position(other)];
  const way = minus(p, q);
  return {
    position_mm: reference === "relativeScene" ? way : alongAxes(other, way),
    angles_deg: anglesFrom(other, pose),
  };
}

/** Its inverse. */
export function withPlaceIn({ position_mm, angles_deg }: Place, reference: Reference, other: Pose): Pose {
  if (reference === "absolute") return fromPositionQuaternion(position_mm, orientationFrom(IDENTITY, angles_deg));
  const turned = fromPositionQuaternion(position(other), orientationFrom(other, angles_deg));
  if (reference === "relativeScene") return withPosition(turned, plus(position(other), position_mm));
  return withPosition(turned, position(translated(other, position_mm)));
}

/** A direction in the scene as the pose's own axes have it. */
function alongAxes(pose: Pose, way: Vector): Vector {
  return [dot(axis(pose, 0), way), dot(axis(pose, 1), way), dot(axis(pose, 2), way)];
}

/** What a registration makes of poses. */
export interface Registered {
  name: string;
  baseToScene: Pose;
  probeToFlange: Pose;
}

export function registeredBy({ name, base_to_scene, probe_to_flange }: Registration): Registered {
  return { name, baseToScene: base_to_scene.flat(), probeToFlange: probe_to_flange.flat() };
}

/** Whether both convert every pose alike. */
export function leadAlike(one: Registered, other: Registered): boolean {
  const same = (of: Pose, as: Pose): boolean => of.every((value, place) => value === as[place]);
  return same(one.baseToScene, other.baseToScene) && same(one.probeToFlange, other.probeToFlange);
}

/** Flange to base of a pose of the probe in the scene. */
export function flangePose({ baseToScene, probeToFlange }: Registered, pose: Pose): Pose {
  return composed(inverse(baseToScene), composed(pose, inverse(probeToFlange)));
}

/** Its inverse. */
export function probePose({ baseToScene, probeToFlange }: Registered, flange: Pose): Pose {
  return composed(baseToScene, composed(flange, probeToFlange));
}

/** The corners of a box about all places of the flange whose probe is within a box of the scene. */
export function flangeBounds({ baseToScene, probeToFlange }: Registered, low: Vector, high: Vector): { low: Vector; high: Vector } {
  const back = inverse(baseToScene);
  const reach_mm = length(position(probeToFlange));
  const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((bits) =>
    apply(back, [0, 1, 2].map((axis) => (bits & (1 << axis) ? high : low)[axis]!) as unknown as Vector),
  );
  const outermost = (choose: (...values: number[]) => number, by_mm: number): Vector =>
    [0, 1, 2].map((axis) => choose(...corners.map((corner) => corner[axis]!)) + by_mm) as unknown as Vector;
  return { low: outermost(Math.min, -reach_mm), high: outermost(Math.max, reach_mm) };
}
