/** What is dragged in space: the probe, over the skin and by a gizmo that moves and turns it, and a point by a gizmo. */

import { type Camera, Group, type Intersection, Mesh, type Object3D, Plane, Raycaster, Vector2, Vector3 } from "three";
import { TransformControls } from "three/examples/jsm/controls/TransformControls.js";

import type { ImagePlane } from "../api/contract";
import { axis, dot, fromPositionQuaternion, IDENTITY, minus, type Pose, position, translated, type Vector } from "../geometry/pose";
import { drop, placeObject, probeBody } from "./bodies";
import { OCCLUDERS } from "./cloud";

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

export type Gizmo = "translate" | "rotate" | "none";

const LEAST_SLOPE = 0.25; // of the line of sight to the plane that the body slides in; below, it slides across the view

interface Events<Place> {
  changed: () => void;
  /** Whether it is dragged now. */
  handled: (now: boolean) => void;
  /** Where it is dragged to. */
  moved: (to: Place) => void;
}

const GIZMO_SIZE = 0.7;

function gizmoOf(object: Object3D, camera: Camera, element: HTMLElement, { changed, handled }: Events<never>): TransformControls {
  const gizmo = new TransformControls(camera, element);
  gizmo.size = GIZMO_SIZE;
  gizmo.attach(object);
  gizmo.addEventListener("change", changed);
  gizmo.addEventListener("dragging-changed", ({ value }) => handled(value === true));
  return gizmo;
}

function show(gizmo: TransformControls, isShown: boolean): void {
  gizmo.enabled = gizmo.getHelper().visible = isShown;
}

/** A point with a gizmo that moves it along the axes of the scene. */
export class PointHandle {
  readonly object = new Group();
  readonly #gizmo: TransformControls;

  constructor(camera: Camera, element: HTMLElement, events: Events<Vector>) {
    this.#gizmo = gizmoOf(this.object, camera, element, events);
    this.#gizmo.addEventListener("objectChange", () => events.moved(this.object.position.toArray()));
    this.#gizmo.addEventListener("axis-changed", ({ value }) => (element.style.cursor = value === null ? "" : "grab"));
    this.put(null);
  }

  get helper(): Object3D {
    return this.#gizmo.getHelper();
  }

  /** null: there is none. */
  put(point: Vector | null): void {
    show(this.#gizmo, point !== null);
    if (point !== null && !this.#gizmo.dragging) this.object.position.set(...point); // else the pointer has it
  }

  dispose(): void {
    this.#gizmo.dispose();
  }
}

export class ProbeHandle {
  /** Lies in the middle of the face, about which the probe is turned. */
  readonly object = new Group();
  readonly #gizmo: TransformControls;
  #pose: Pose = IDENTITY;
  #pivotDepth_mm = 0;
  #held = false;
  /** Where the body was taken, from its face, and the plane that it slides in. */
  #taken: { offset: Vector3; plane: Plane; pointer: number } | null = null;

  constructor(
    private readonly camera: Camera,
    private readonly element: HTMLElement,
    private readonly events: Events<Pose>,
  ) {
    this.#gizmo = gizmoOf(this.object, camera, element, events);
    this.#gizmo.space = "local";
    this.#gizmo.addEventListener("objectChange", () => this.#report(this.#gizmo.axis?.includes("Z") ?? false));
    // before the controls of the view, which lie on the same element
    element.parentElement!.addEventListener("pointerdown", this.#take, { capture: true });
    element.addEventListener("pointermove", this.#drag);
    element.addEventListener("pointerup", this.#letGo);
    element.addEventListener("pointercancel", this.#letGo);
  }

  get helper(): Object3D {
    return this.#gizmo.getHelper();
  }

  setGizmo(gizmo: Gizmo): void {
    this.#held = gizmo !== "none";
    if (gizmo !== "none") this.#gizmo.setMode(gizmo);
    else this.element.style.cursor = "";
    show(this.#gizmo, this.#held);
  }

  setProbe(plane: ImagePlane): void {
    for (const body of [...this.object.children]) drop(body);
    this.#pivotDepth_mm = plane.pivot_depth_mm;
    const body = probeBody(plane);
    body.position.z = -this.#pivotDepth_mm;
    body.traverse((part) => part instanceof Mesh && part.layers.enable(OCCLUDERS));
    this.object.add(body);
    this.setPose(this.#pose);
  }

  setPose(pose: Pose): void {
    this.#pose = pose;
    placeObject(this.object, translated(pose, [0, 0, this.#pivotDepth_mm]));
  }

  dispose(): void {
    this.element.parentElement?.removeEventListener("pointerdown", this.#take, { capture: true });
    this.#gizmo.dispose();
    drop(this.object);
  }

  /** Tells where the probe was dragged to. Only a handle along its axis presses it: what a curved skin leaves is no press. */
  #report(presses: boolean): void {
    const { position: p, quaternion: q } = this.object;
    const face = fromPositionQuaternion([p.x, p.y, p.z], [q.w, q.x, q.y, q.z]);
    const to = translated(face, [0, 0, -this.#pivotDepth_mm]);
    const turned = this.#gizmo.mode === "rotate" && this.#taken === null;
    if (presses || turned) return this.events.moved(to);
    const lifted = dot(minus(position(to), position(this.#pose)), axis(this.#pose, 2));
    this.events.moved(translated(to, [0, 0, -lifted]));
  }

  /** Where the body is pointed at. */
  #hit(ray: Raycaster): Intersection | undefined {
    return ray.intersectObject(this.object, true).find(({ object }) => object instanceof Mesh);
  }

  /** The pointer tells what can be dragged. */
  #tell(event: PointerEvent): void {
    const over = this.#gizmo.axis === null && this.#hit(pointedAt(event, this.camera)) !== undefined;
    this.element.style.cursor = this.#gizmo.axis !== null ? "grab" : over ? "move" : "";
  }

  #take = (event: PointerEvent): void => {
    if (!this.#held || event.target !== this.element || event.button !== 0 || !event.isPrimary) return;
    const { x, y } = placeOf(event);
    this.#gizmo.pointerHover({ x, y, button: event.button } as unknown as PointerEvent); // a finger has not hovered
    if (this.#gizmo.axis !== null) return; // a handle lies over the body
    const ray = pointedAt(event, this.camera);
    const hit = this.#hit(ray);
    if (hit === undefined) return;
    const along = new Vector3(...axis(this.#pose, 2));
    const sight = ray.ray.direction;
    const normal = Math.abs(along.dot(sight)) < LEAST_SLOPE ? sight.clone().negate() : along;
    const plane = new Plane().setFromNormalAndCoplanarPoint(normal, hit.point);
    this.#taken = { offset: this.object.position.clone().sub(hit.point), plane, pointer: event.pointerId };
    this.element.setPointerCapture(event.pointerId);
    this.element.style.cursor = "grabbing";
    this.events.handled(true);
    event.preventDefault();
  };

  #drag = (event: PointerEvent): void => {
    if (this.#held && this.#taken === null && event.buttons === 0) this.#tell(event);
    if (this.#taken?.pointer !== event.pointerId) return;
    const at = pointedAt(event, this.camera).ray.intersectPlane(this.#taken.plane, new Vector3());
    if (at === null) return;
    this.object.position.copy(at.add(this.#taken.offset));
    this.#report(false);
  };

  #letGo = (event: PointerEvent): void => {
    if (this.#taken?.pointer !== event.pointerId) return;
    this.#taken = null;
    this.element.style.cursor = "";
    this.events.handled(false);
  };
}
