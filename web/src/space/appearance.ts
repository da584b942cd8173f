/** How the scene is shown in space: the options of the view, and the colours that stand for values. */

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
