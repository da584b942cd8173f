/** The probe as a thing: a body behind its face, the mark on its left side, the outline of its image plane. */

import {
  BoxGeometry,
  BufferAttribute,
  BufferGeometry,
  CylinderGeometry,
  Group,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshLambertMaterial,
  SphereGeometry,
} from "three";

import { areAllAround, boxOf, shortened, type ImagePlane } from "../geometry/plane";
import { planeShape } from "./shapes";

const THICKNESS_MM = 9;
const BODY_MM = 13;
const HANDLE_MM = 26;
const LEAST_FACE_MM = 14;

/** In the probe frame; what it sends into is +z, or all around it: then it is a catheter along the elevation. */
export function probeBody({ lines_mm, pivot_depth_mm: face }: ImagePlane): Group {
  const { left, right } = boxOf(shortened(lines_mm, 0));
  const width = Math.max(LEAST_FACE_MM, right - left);
  const body = new Group();
  const shell = new MeshLambertMaterial({ color: 0xdfe5ea });
  const mark = new Mesh(new SphereGeometry(2.2, 16, 12), new MeshLambertMaterial({ color: 0x5bbde4 }));
  if (areAllAround(lines_mm)) {
    const radius = Math.max(0.2, (right - left) / 2);
    const catheter = new Mesh(new CylinderGeometry(radius, radius, HANDLE_MM, 20), shell);
    catheter.position.y = -HANDLE_MM / 2;
    mark.position.set(-radius, -HANDLE_MM / 2, 0);
    body.add(catheter);
  } else {
    const head = new Mesh(new BoxGeometry(width, THICKNESS_MM, BODY_MM), shell);
    head.position.z = face - BODY_MM / 2;
    const handle = new Mesh(new CylinderGeometry(4.5, 5.5, HANDLE_MM, 20), shell);
    handle.rotation.x = Math.PI / 2;
    handle.position.z = face - BODY_MM - HANDLE_MM / 2;
    mark.position.set(-width / 2, 0, face - BODY_MM / 2);
    body.add(head, handle);
  }
  const shape = planeShape(lines_mm);
  const outline = new BufferGeometry().setAttribute("position", new BufferAttribute(shape.positions, 3));
  outline.setIndex(shape.outline);
  return body.add(mark, new LineSegments(outline, new LineBasicMaterial({ color: 0xffc94d })));
}
