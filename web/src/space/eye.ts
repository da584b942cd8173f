/** The eye of the person: turned by dragging, put to viewpoints, and what cuts the scene open before it. */

import { PerspectiveCamera, type Plane, Vector3 } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

import { apply, axis, IDENTITY, length, minus, type Pose } from "../geometry/pose";
import type { Cut, CutAcross } from "./appearance";
import type { Look } from "./viewpoints";

export const SEEN_DEG = 34;
const KEY_STEP_RAD = 0.12;
const KEY_ZOOM = 1.15;

interface Events {
  /** The eye is somewhere else. */
  moved: () => void;
  /** Whether the person turns the view now. */
  handled: (now: boolean) => void;
}

export class Eye {
  readonly camera = new PerspectiveCamera(SEEN_DEG, 1, 1, 5000);
  #orbit: OrbitControls;

  constructor(
    private readonly element: HTMLElement,
    private readonly events: Events,
  ) {
    this.#orbit = this.#controls();
  }

  set enabled(enabled: boolean) {
    this.#orbit.enabled = enabled;
  }

  get look(): Look {
    const { camera } = this;
    return {
      position: camera.position.toArray(),
      target: this.#orbit.target.toArray(),
      up: camera.up.toArray(),
    };
  }

  set look({ position, target, up }: Look) {
    if (this.camera.up.distanceTo(new Vector3(...up)) > 1e-6) {
      this.camera.up.set(...up);
      this.#orbit.dispose(); // they take what is up once, when they are made
      this.#orbit = this.#controls();
    }
    this.camera.position.set(...position);
    this.#orbit.target.set(...target);
    const away = length(minus(position, target));
    this.camera.near = away / 60;
    this.camera.far = away * 20;
    this.camera.updateProjectionMatrix();
    this.#orbit.update();
    this.events.moved();
  }

  resize(aspect: number): void {
    this.camera.aspect = aspect;
    this.camera.updateProjectionMatrix();
  }

  /** Goes round by a key; true where it is one of those. */
  press(key: string): boolean {
    const ways: Record<string, () => void> = {
      ArrowLeft: () => this.#orbit.rotateLeft(KEY_STEP_RAD),
      ArrowRight: () => this.#orbit.rotateLeft(-KEY_STEP_RAD),
      ArrowUp: () => this.#orbit.rotateUp(KEY_STEP_RAD),
      ArrowDown: () => this.#orbit.rotateUp(-KEY_STEP_RAD),
      "+": () => this.#orbit.dollyIn(1 / KEY_ZOOM),
      "-": () => this.#orbit.dollyOut(1 / KEY_ZOOM),
    };
    ways[key]?.();
    return key in ways;
  }

  dispose(): void {
    this.#orbit.dispose();
  }

  #controls(): OrbitControls {
    const orbit = new OrbitControls(this.camera, this.element);
    orbit.addEventListener("change", this.events.moved);
    orbit.addEventListener("start", () => this.events.handled(true));
    orbit.addEventListener("end", () => this.events.handled(false));
    return orbit;
  }
}

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
