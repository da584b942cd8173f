/** The tools of an image as things in space: solid, and as a pale trace through the tissue that hides them. */

import { BoxGeometry, CylinderGeometry, Group, Mesh, MeshBasicMaterial, MeshLambertMaterial, Vector3, type BufferGeometry } from "three";

import type { Tool } from "../api/tools";
import type { Pose } from "../geometry/pose";
import { isRod, lengthOf, poseOfBox } from "../geometry/tool_place";
import { OCCLUDERS } from "./cloud";
import { drop } from "./drop";
import { placeObject } from "./place";

const COLOUR = 0xff8a5c;
const TRACE = { opacity: 0.4, order: 11 }; // after the tissue, which is laid over at 10
const THINNEST_MM = 0.5; // radius: what is thinner is not seen
const SIDES = 16;
const UP = new Vector3(0, 1, 0); // along which three.js makes cylinders

export class ToolBodies {
  readonly object = new Group();
  /** Those that move with the probe. */
  readonly #held = new Group();

  constructor() {
    this.object.add(this.#held);
  }

  set(tools: readonly Tool[]): void {
    for (const body of this.object.children.filter((one) => one !== this.#held)) drop(body);
    for (const body of [...this.#held.children]) drop(body);
    for (const tool of tools) (tool.frame === "probe" ? this.#held : this.object).add(bodyOf(tool));
  }

  setPose(pose: Pose): void {
    placeObject(this.#held, pose);
  }

  dispose(): void {
    drop(this.object);
  }
}

function bodyOf(tool: Tool): Group {
  const geometry = isRod(tool) ? rodGeometry(lengthOf(tool), tool.diameter_mm) : new BoxGeometry(...tool.size_mm);
  const body = new Group().add(...partsOf(geometry));
  if (!isRod(tool)) {
    placeObject(body, poseOfBox(tool));
    return body;
  }
  const [tip, hub] = [new Vector3(...tool.tip_mm), new Vector3(...tool.hub_mm)];
  body.position.copy(tip).add(hub).divideScalar(2);
  body.quaternion.setFromUnitVectors(UP, hub.sub(tip).normalize());
  return body;
}

function rodGeometry(length_mm: number, diameter_mm: number): CylinderGeometry {
  const radius_mm = Math.max(THINNEST_MM, diameter_mm / 2);
  return new CylinderGeometry(radius_mm, radius_mm, length_mm, SIDES);
}

function partsOf(geometry: BufferGeometry): [Mesh, Mesh] {
  const solid = new Mesh(geometry, new MeshLambertMaterial({ color: COLOUR }));
  solid.layers.enable(OCCLUDERS);
  const seenThrough = { transparent: true, opacity: TRACE.opacity, depthTest: false, depthWrite: false };
  const trace = new Mesh(geometry, new MeshBasicMaterial({ color: COLOUR, ...seenThrough }));
  trace.renderOrder = TRACE.order;
  return [solid, trace];
}
