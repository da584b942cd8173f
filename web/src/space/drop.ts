/** What a view of three.js no longer shows. */

import { InstancedMesh, LineSegments, Mesh, type Object3D } from "three";

/** Removes an object, and frees what it and all within it hold on the graphics card. */
export function drop(object: Object3D): void {
  object.traverse((part) => {
    if (!(part instanceof Mesh || part instanceof LineSegments)) return;
    part.geometry.dispose();
    for (const material of [part.material].flat()) material.dispose();
    if (part instanceof InstancedMesh) part.dispose();
  });
  object.removeFromParent();
}
