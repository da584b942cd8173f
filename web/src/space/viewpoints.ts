/** From where the scene is looked at, so that left and right are those of the image, whatever the scene's own axes. */

import { axis, cross, dot, length, plus, type Pose, scaled, unit, type Vector } from "../geometry/pose";

/** `behind`: as the image is seen; `side`: along its lateral axis; `top`: from above the probe; `whole`: between them. */
export type Viewpoint = "whole" | "behind" | "side" | "top";

export interface Look {
  position: Vector;
  target: Vector;
  /** What is above in the picture. */
  up: Vector;
}

export interface Box {
  low: Vector;
  high: Vector;
}

/** Of the person who holds the probe and looks at its image. Unit vectors in the scene. */
export interface Sides {
  /** Where the right side of the image lies. */
  right: Vector;
  up: Vector;
  /** From the image to the person. */
  back: Vector;
}

/** Shares of right, up and back of the way from what is looked at to the eye. */
const TOWARDS: Record<Viewpoint, Vector> = {
  whole: [0.5, 0.45, 1],
  behind: [0, 0.1, 1],
  side: [1, 0.1, 0.02],
  top: [0, 1, 0.02],
};
const LEAST_AGREEMENT = 0.5; // of the axes of a sweep, 1 where all run alike
const MARGIN = 1.06;

/** The sides of an image. `flip`: whether it is shown mirrored; `views`: the sweep, whose common axis says what is up. */
export function sidesOf(pose: Pose, flip: boolean, views: readonly Pose[]): Sides {
  const down = axis(pose, 2);
  const along = views.map((view) => axis(view, 2)).reduce(plus, [0, 0, 0]);
  const common = scaled(along, 1 / Math.max(1, views.length));
  const agrees = length(common) > LEAST_AGREEMENT && dot(unit(common), down) > LEAST_AGREEMENT;
  const up = scaled(agrees ? unit(common) : down, -1);
  const lateral = scaled(axis(pose, 0), flip ? -1 : 1);
  const right = unit(plus(lateral, scaled(up, -dot(lateral, up))));
  return { right, up, back: cross(right, up) };
}

/** Where the eye must be to see a whole box. `angle_deg`: how far the camera sees from bottom to top; `aspect`: width to height. */
export function lookFrom(viewpoint: Viewpoint, sides: Sides, box: Box, angle_deg: number, aspect: number): Look {
  const [x, y, z] = TOWARDS[viewpoint];
  const away = unit(plus(plus(scaled(sides.right, x), scaled(sides.up, y)), scaled(sides.back, z)));
  const target = scaled(plus(box.low, box.high), 0.5);
  const right = unit(cross(sides.up, away));
  const up = cross(away, right);
  const tangent = Math.tan((angle_deg / 360) * Math.PI);
  const distances = corners(box).map((corner) => {
    const from = plus(corner, scaled(target, -1));
    const needed = Math.max(Math.abs(dot(from, up)) / tangent, Math.abs(dot(from, right)) / (tangent * aspect));
    return needed * MARGIN + dot(from, away);
  });
  return { position: plus(target, scaled(away, Math.max(1, ...distances))), target, up: sides.up };
}

export function corners({ low, high }: Box): Vector[] {
  const ends = [low, high] as const;
  return Array.from({ length: 8 }, (_, bits) => [ends[bits & 1]![0], ends[(bits >> 1) & 1]![1], ends[bits >> 2]![2]] as const);
}
