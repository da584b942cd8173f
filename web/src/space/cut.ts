/** The plane that cuts the scene open: the side of the eye is left out. */

import { Vector3, type Plane } from "three";

import { apply, axis, IDENTITY, type Pose } from "../geometry/pose";
import type { Cut, CutAcross } from "./appearance";

type Across = Exclude<CutAcross, "none">;

/** The axis that each is across. */
const AXES: Record<Across, 0 | 1 | 2> = { image: 1, lateral: 0, elevation: 1, axial: 2, x: 0, y: 1, z: 2 };
const OF_SCENE: readonly CutAcross[] = ["x", "y", "z"];

/** Puts the plane where the cut is, or so that it cuts nothing. `image`: the pose of the live image, where there is one. */
export function placeCut(plane: Plane, { across, at_mm }: Cut, image: Pose | null, eye: Vector3): void {
  const frame = OF_SCENE.includes(across) ? IDENTITY : image;
  if (across === "none" || frame === null) {
    plane.setComponents(0, 0, 0, 1);
    return;
  }
  const along = AXES[across];
  const from = [0, 0, 0] as [number, number, number];
  if (across !== "image") from[along] = at_mm;
  const point = new Vector3(...apply(frame, from));
  const normal = new Vector3(...axis(frame, along));
  if (normal.dot(eye.clone().sub(point)) > 0) normal.negate();
  plane.setFromNormalAndCoplanarPoint(normal, point);
}
