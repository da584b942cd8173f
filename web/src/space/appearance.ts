/** How the scene is shown in space: the options of the view, the colours that stand for values, and from where it is looked at. */

import { axis, cross, dot, length, plus, type Pose, scaled, unit, type Vector } from "../geometry/pose";
import { type Colour, labelColour, ramp } from "../shared/colours";

/** `shaded`: the volume as a body in light; `maximum`: the brightest along each line of sight; `splats`: each Gaussian. */
export type Form = "shaded" | "maximum" | "splats" | "none";
export type ColourBy = "intensity" | "label" | "coverage" | "transmittance";
/** What makes a place opaque: its echo, or that it lets no sound pass. */
export type SolidBy = "echo" | "shadow";

export interface Appearance {
  form: Form;
  colour: ColourBy;
  solid: SolidBy;
  /** Of what makes opaque, 0 to 1; less is not shown. */
  threshold: number;
  opacity: number;
  /** Of splats, in standard deviations. */
  size: number;
  /** Labels that are left out. */
  hidden: readonly number[];
}

export const USUAL: Appearance = {
  form: "shaded",
  colour: "intensity",
  solid: "echo",
  threshold: 0.55,
  opacity: 0.9,
  size: 0.6,
  hidden: [],
};

/** A plane that cuts the scene: that of the image, one across the probe, or one across the scene. */
export type CutAcross = "none" | "image" | "lateral" | "elevation" | "axial" | "x" | "y" | "z";

export interface Cut {
  across: CutAcross;
  /** Along the axis that it is across, from the probe or in the scene. */
  at_mm: number;
}

/** Of a palette. */
export const ENTRIES = 256;
/** The colour of a share of the values, 0 to 1; of labels, the share is the label in 255ths. */
export function colourOf(by: ColourBy, share: number): Colour {
  if (by === "label") return share === 0 ? [120, 128, 136] : labelColour(Math.round(share * (ENTRIES - 1)));
  return ramp(by === "intensity" ? "tissue" : by, share);
}

/** Between which the middle 96 % of the values lie. */
export function middleOf(values: Float32Array): [number, number] {
  const sorted = values.sort();
  const low = sorted[Math.floor(sorted.length * 0.02)] ?? 0;
  const high = sorted[Math.floor(sorted.length * 0.98)] ?? 1;
  return [low, high > low ? high : low + 1];
}

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
