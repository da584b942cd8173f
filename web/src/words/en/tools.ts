/** Tools in the image, in English. */

import type { ToolFrame, ToolKind } from "../../api/contract";

const kinds: Record<ToolKind, string> = { needle: "Needle", cylinder: "Cylinder", box: "Box" };
const frames: Record<ToolFrame, string> = { scene: "Stays in the scene", probe: "Moves with the probe" };

export const tools = {
  title: "Tools",
  label: "Tools in the image",
  frozen: "Frozen: the image keeps its tools. Unfreeze to change them.",
  add: "Add",
  addOne: (kind: ToolKind): string => `Add a ${kinds[kind].toLowerCase()}`,
  kinds,
  one: (place: number, kind: ToolKind): string => `${place} ${kinds[kind]}`,
  chosen: "Tool",
  remove: "Remove",
  full: (most: number): string => `An image takes at most ${most} tools.`,
  frame: "Frame of the tool",
  frames,
  toImage: "To the image",
  toImageMeans: "Put it into the image plane, where the probe is now",
  tip: "Tip",
  middle: "Middle",
  placeOf: (what: string, axis: string): string => `${what} ${axis}`,
  direction: "Direction",
  steepness: "Steepness",
  steepnessMeans: "Steepness: how steeply it goes down along Z, from -89° to 89°",
  heading: "Heading",
  headingMeans: "Heading: from X towards Y, seen along Z",
  turn: "Turn",
  size: "Size",
  length: "Length",
  ghost: "Ghosts",
  ghostMeans: "Ghost echoes",
  along: "Along its axis",
  advance: (by_mm: number): string => (by_mm > 0 ? `Advance by ${by_mm} mm` : `Withdraw by ${-by_mm} mm`),
  seen: (what: string, beside_mm: string, depth_mm: string): string => `${what}: ${beside_mm} mm beside the image, ${depth_mm} mm deep`,
  inPlane: (what: string, depth_mm: string): string => `${what}: in the image, ${depth_mm} mm deep`,
  look: "Look and label",
};
