/** How the Gaussians of a scene are shown: what the options of the 3D view say. */

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
