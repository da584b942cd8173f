/** Registrations of robots and trackers, in English. */

import type { Reference } from "../../geometry/pose";

export const registrations = {
  title: "Registrations",
  none: "None is stored. A registration says how the poses of a robot or a tracker lead into a scene: ultragray calibrate finds one.",
  meaning: "Poses are shown and typed",
  inScene: "of the probe, in the scene",
  into: (scene: string): string => `into ${scene}`,
  residual: (amounts: string): string => `residual ${amounts}`,
  residualMeans: "Root mean square of what was left when it was found",
  noResidual: "residual not told",
  references: (name: string): Record<Reference, string> => ({
    absolute: `Absolute, as ${name} tells it`,
    relativeScene: `Relative, along the axes of ${name}`,
    relativeProbe: "Relative, along the flange's axes",
  }),
  position: (name: string): string => `Position of the flange, as ${name} tells it`,
  angles: (name: string): string => `Angles against the axes of ${name}`,
  about: (axis: string): string => `About ${axis}`,
  form: (name: string): string => `Flange to base, as ${name} tells it`,
  gone: (name: string, scene: string | null): string =>
    `${name} ${scene === null ? "is not stored any more" : `is of the scene ${scene} now`}: poses are those of the probe again.`,
  tag: (name: string): string => `by ${name}`,
  tagMeans: "Poses are told by this registration; chosen below, among the registrations",
};
