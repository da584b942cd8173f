/** Where a pose is and how it is turned, told against different things. */

import {
  anglesFrom,
  apply,
  fromPositionQuaternion,
  IDENTITY,
  orientationFrom,
  position,
  quaternion,
  translated,
  withPosition,
  type Pose,
  type Vector,
} from "./pose";

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
  const way: Vector = [p[0] - q[0], p[1] - q[1], p[2] - q[2]];
  return {
    position_mm: reference === "relativeScene" ? way : alongAxes(other, way),
    angles_deg: anglesFrom(other, pose),
  };
}

/** Its inverse. */
export function withPlaceIn({ position_mm, angles_deg }: Place, reference: Reference, other: Pose): Pose {
  if (reference === "absolute") return fromPositionQuaternion(position_mm, orientationFrom(IDENTITY, angles_deg));
  const turned = fromPositionQuaternion(position(other), orientationFrom(other, angles_deg));
  const [x, y, z] = position(other);
  if (reference === "relativeScene")
    return withPosition(turned, [x + position_mm[0], y + position_mm[1], z + position_mm[2]]);
  return withPosition(turned, position(translated(other, position_mm)));
}

/** A direction in the scene as the pose's own axes have it. */
function alongAxes(pose: Pose, way: Vector): Vector {
  const q = quaternion(pose);
  return apply(fromPositionQuaternion([0, 0, 0], [q[0], -q[1], -q[2], -q[3]]), way);
}
