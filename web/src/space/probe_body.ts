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

import type { Probe } from "../api/scenes";
import { faceDepth_mm } from "../geometry/picture";
import { planeShape } from "./shapes";

const THICKNESS_MM = 9;
const BODY_MM = 13;
const HANDLE_MM = 26;
const PHASED_FACE_MM = 20;

/** In the probe frame; what it sends into is +z. */
export function probeBody(probe: Probe): Group {
  const face = faceDepth_mm(probe);
  const width = faceWidth_mm(probe);
  const shell = new MeshLambertMaterial({ color: 0xdfe5ea });
  const head = new Mesh(new BoxGeometry(width, THICKNESS_MM, BODY_MM), shell);
  head.position.z = face - BODY_MM / 2;
  const handle = new Mesh(new CylinderGeometry(4.5, 5.5, HANDLE_MM, 20), shell);
  handle.rotation.x = Math.PI / 2;
  handle.position.z = face - BODY_MM - HANDLE_MM / 2;
  const mark = new Mesh(new SphereGeometry(2.2, 16, 12), new MeshLambertMaterial({ color: 0x5bbde4 }));
  mark.position.set(-width / 2, 0, face - BODY_MM / 2);
  const shape = planeShape(probe);
  const outline = new BufferGeometry().setAttribute("position", new BufferAttribute(shape.positions, 3));
  outline.setIndex(shape.outline);
  return new Group().add(head, handle, mark, new LineSegments(outline, new LineBasicMaterial({ color: 0xffc94d })));
}

function faceWidth_mm(probe: Probe): number {
  if (probe.kind === "linear") return probe.width_mm;
  if (probe.kind === "phased") return PHASED_FACE_MM;
  return Math.max(10, 2 * probe.near_mm * Math.sin((probe.opening_angle_deg / 360) * Math.PI));
}
