/** Vectors and rigid transforms: poses lead from the probe to the scene, as 16 numbers row by row, translation in mm. */

/** A matrix [4, 4] of 16 numbers, row by row. */
export type Pose = readonly number[];
export type Vector = readonly [number, number, number];
/** w, x, y, z. */
export type Quaternion = readonly [number, number, number, number];

export const DEGREES = 180 / Math.PI;

export const IDENTITY: Pose = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

export const plus = (a: Vector, b: Vector): Vector => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const minus = (a: Vector, b: Vector): Vector => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scaled = (a: Vector, by: number): Vector => [a[0] * by, a[1] * by, a[2] * by];
export const length = (a: Vector): number => Math.hypot(...a);

/** The entry in row `row` and column `column`. */
export function entry(pose: Pose, row: number, column: number): number {
  return pose[row * 4 + column] ?? 0;
}

export function position(pose: Pose): Vector {
  return [entry(pose, 0, 3), entry(pose, 1, 3), entry(pose, 2, 3)];
}

export function withPosition(pose: Pose, [x, y, z]: Vector): Pose {
  const moved = [...pose];
  [moved[3], moved[7], moved[11]] = [x, y, z];
  return moved;
}

/** The pose moved along the probe's own axes, in mm. */
export function translated(pose: Pose, along: Vector): Pose {
  return withPosition(pose, apply(pose, along));
}

/** Where a point of the probe frame lies in the scene. */
export function apply(pose: Pose, [x, y, z]: Vector): Vector {
  const row = (i: number): number =>
    entry(pose, i, 0) * x + entry(pose, i, 1) * y + entry(pose, i, 2) * z + entry(pose, i, 3);
  return [row(0), row(1), row(2)];
}

/** The pose turned about the probe's own axes by small angles in degrees; the point `pivot_mm` deep on its axis stays. */
export function rotated(pose: Pose, angles_deg: Vector, pivot_mm: number): Pose {
  return pivoted(pose, normalised(orientationFrom(pose, angles_deg)), pivot_mm);
}

/** The pose with another orientation, the point `pivot_mm` deep on its axis where it was. */
export function pivoted(pose: Pose, orientation: Quaternion, pivot_mm: number): Pose {
  const stays = apply(pose, [0, 0, pivot_mm]);
  return translated(fromPositionQuaternion(stays, orientation), [0, 0, -pivot_mm]);
}

/** Raises nothing: the quaternion is brought to length 1. */
export function fromPositionQuaternion([x, y, z]: Vector, quaternionGiven: Quaternion): Pose {
  const [w, i, j, k] = normalised(quaternionGiven);
  return [
    1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j), x,
    2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i), y,
    2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j), z,
    0, 0, 0, 1,
  ]; // prettier-ignore
}

/** With w ≥ 0. */
export function quaternion(pose: Pose): Quaternion {
  const m = (row: number, column: number): number => entry(pose, row, column);
  const squares = [
    1 + m(0, 0) + m(1, 1) + m(2, 2),
    1 + m(0, 0) - m(1, 1) - m(2, 2),
    1 - m(0, 0) + m(1, 1) - m(2, 2),
    1 - m(0, 0) - m(1, 1) + m(2, 2),
  ];
  const largest = squares.indexOf(Math.max(...squares));
  const products: Quaternion[] = [
    [squares[0]!, m(2, 1) - m(1, 2), m(0, 2) - m(2, 0), m(1, 0) - m(0, 1)],
    [m(2, 1) - m(1, 2), squares[1]!, m(1, 0) + m(0, 1), m(0, 2) + m(2, 0)],
    [m(0, 2) - m(2, 0), m(1, 0) + m(0, 1), squares[2]!, m(2, 1) + m(1, 2)],
    [m(1, 0) - m(0, 1), m(0, 2) + m(2, 0), m(2, 1) + m(1, 2), squares[3]!],
  ];
  const q = normalised(products[largest]!);
  return q[0] < 0 ? [-q[0], -q[1], -q[2], -q[3]] : q;
}

export function multiply([a, b, c, d]: Quaternion, [e, f, g, h]: Quaternion): Quaternion {
  return [
    a * e - b * f - c * g - d * h,
    a * f + b * e + c * h - d * g,
    a * g - b * h + c * e + d * f,
    a * h + b * g - c * f + d * e,
  ];
}

function normalised([w, x, y, z]: Quaternion): Quaternion {
  const length = Math.hypot(w, x, y, z);
  return length === 0 ? [1, 0, 0, 0] : [w / length, x / length, y / length, z / length];
}

/** A turn about an axis of length 1. */
export function aboutAxis([x, y, z]: Vector, angle_deg: number): Quaternion {
  const half = angle_deg / DEGREES / 2;
  const s = Math.sin(half);
  return [Math.cos(half), x * s, y * s, z * s];
}

/** The orientation with those angles against `home`. */
export function orientationFrom(home: Pose, [tilt_deg, rock_deg, rotation_deg]: Vector): Quaternion {
  const turn = multiply(
    multiply(aboutAxis([0, 0, 1], rotation_deg), aboutAxis([0, 1, 0], rock_deg)),
    aboutAxis([1, 0, 0], tilt_deg),
  );
  return multiply(quaternion(home), turn);
}

export function distance_mm(a: Pose, b: Pose): number {
  return length(minus(position(a), position(b)));
}

/** The angle between two orientations. */
export function angle_deg(a: Pose, b: Pose): number {
  const [p, q] = [quaternion(a), quaternion(b)];
  const dot = Math.abs(p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]);
  return 2 * Math.acos(Math.min(1, dot)) * DEGREES;
}
