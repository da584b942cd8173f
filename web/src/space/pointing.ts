/** What the pointer points at. */

import { Raycaster, Vector2, type Camera } from "three";

/** The place of the pointer on the element, -1 to 1 each way, y up. */
export function placeOf(event: MouseEvent): Vector2 {
  const { left, top, width, height } = (event.target as Element).getBoundingClientRect();
  return new Vector2((2 * (event.clientX - left)) / width - 1, 1 - (2 * (event.clientY - top)) / height);
}

export function pointedAt(event: MouseEvent, camera: Camera): Raycaster {
  const ray = new Raycaster();
  ray.setFromCamera(placeOf(event), camera);
  return ray;
}
