/** The 3D view: when it is drawn and how finely, the eye of the person, and what stands in the room. */

import {
  AmbientLight, Color, DirectionalLight, Group, type LineSegments, Mesh, PerspectiveCamera, Plane, Scene,
  Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

import type { ImagePlane, Tool } from "../api/contract";
import type { Gaussians } from "../api/gaussians";
import type { Frame } from "../api/stream";
import type { Placed } from "../geometry/plane";
import { apply, axis, IDENTITY, length, minus, type Pose, type Vector } from "../geometry/pose";
import { middleOf, type Solid } from "../geometry/shapes";
import type { Skin } from "../geometry/skin";
import {
  type Appearance, type Box, type Cut, type CutAcross, type Form, type Look, lookFrom, type Sides,
  type Viewpoint,
} from "./appearance";
import { boxLines, drop, LiveImage, plannedViews, skinMesh, solidBodies, sweepPlanes, ToolBodies } from "./bodies";
import { Cloud, OCCLUDERS, type Sight } from "./cloud";
import { type Gizmo, pointedAt, PointHandle, ProbeHandle } from "./probe_handle";
import type { Volume } from "./volume";

const BUSY_SHARE = 0.3; // of the time, at most, goes into drawing what the live image changes: it comes first itself
const SOFTWARE_SHARE = 0.15; // where the processor draws
const HANDLED_SHARE = 0.8; // while the person turns the view or drags
const STILL_MS = 250; // after the last change it is drawn finely
const BUDGET_MS = { card: 25, software: 40 }; // of one drawing: a click waits for it, and so does the live image
const SCALES = [0.2, 0.3, 0.4, 0.55, 0.75, 1]; // of the pixels, each way
const FIRST_GUESS_MS = { card: 8, software: 250 }; // of the cloud at full size
const TRUST = 0.5; // in the newest measurement

export type Cause = "person" | "frame";

/** When the 3D view is drawn, and how finely: at once for the person, within a share of the time for the live image. */
export class DrawingLoop {
  #request = 0;
  #fence: WebGLSync | null = null;
  #dirty: Cause | null = null;
  /** Of the fine picture, how many bands are drawn; null: all of them. */
  #band: number | null = 0;
  #bands = 1;
  #touched_ms = 0;
  #started_ms = 0;
  #taken_ms = 0;
  #scale = 1;
  /** Of the cloud at full size, as measured. */
  #cost_ms: number;
  #measures = false;
  readonly #kind: "card" | "software";
  /** Whether the person turns the view, or drags the probe. */
  handled = false;

  /** `draw`: draws at a scale of the pixels; true where that says what the cloud costs.
   *
   * `refine`: draws one of so many bands of the fine picture, and shows it with the last; false: nothing is to be refined.
   */
  constructor(
    private readonly context: WebGL2RenderingContext,
    readonly software: boolean,
    private readonly draw: (scale: number) => boolean,
    private readonly refine: (band: number, bands: number) => boolean,
  ) {
    this.#kind = software ? "software" : "card";
    this.#cost_ms = FIRST_GUESS_MS[this.#kind];
  }

  /** Something changed: what the person did is shown at once. */
  touch(cause: Cause): void {
    if (this.#dirty !== "person") this.#dirty = cause;
    this.#touched_ms = performance.now();
    this.#band = 0;
    this.#ask();
  }

  /** What is drawn costs something else from now on. */
  forgetCost(): void {
    this.#cost_ms = FIRST_GUESS_MS[this.#kind];
  }

  /** A fence of a context that was lost would never be signalled. */
  restart(): void {
    this.#fence = null;
    this.touch("person");
  }

  stop(): void {
    cancelAnimationFrame(this.#request);
  }

  #ask(): void {
    if (this.#request === 0) this.#request = requestAnimationFrame(this.#tick);
  }

  #tick = (): void => {
    this.#request = 0;
    if (this.#fence !== null && !this.#finished(this.#fence)) return this.#ask();
    const now = performance.now();
    if (this.#dirty !== null) {
      const after_ms = this.#taken_ms / this.#share(this.#dirty);
      if (now < this.#started_ms + after_ms) return this.#ask();
      this.#drawNow();
    } else if (this.#band !== null) {
      if (now < this.#touched_ms + STILL_MS || this.handled) return this.#ask();
      this.#refineNow(this.#band);
    }
  };

  #drawNow(): void {
    this.#scale = SCALES.findLast((scale) => this.#cost_ms * scale ** 2 <= BUDGET_MS[this.#kind]) ?? SCALES[0]!;
    this.#dirty = null;
    this.#started_ms = performance.now();
    this.#measures = this.draw(this.#scale);
    this.#await();
  }

  /** The next band, so narrow that a click need not wait long. */
  #refineNow(band: number): void {
    if (band === 0) this.#bands = Math.max(1, Math.ceil(this.#cost_ms / BUDGET_MS[this.#kind]));
    this.#started_ms = performance.now();
    this.#measures = false;
    const goesOn = this.refine(band, this.#bands);
    this.#band = goesOn && band < this.#bands - 1 ? band + 1 : null;
    if (goesOn) this.#await();
  }

  #await(): void {
    this.#fence = this.context.fenceSync(this.context.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.context.flush();
    this.#ask();
  }

  #share(cause: Cause): number {
    if (cause === "person") return this.handled ? HANDLED_SHARE : 1;
    return this.software ? SOFTWARE_SHARE : BUSY_SHARE;
  }

  #finished(fence: WebGLSync): boolean {
    if (this.context.getSyncParameter(fence, this.context.SYNC_STATUS) !== this.context.SIGNALED) return false;
    this.context.deleteSync(fence);
    this.#fence = null;
    this.#taken_ms = performance.now() - this.#started_ms;
    if (this.#measures) this.#cost_ms += TRUST * (this.#taken_ms / this.#scale ** 2 - this.#cost_ms);
    return true;
  }
}

/** Whether the processor draws, for want of a graphics card. */
export function drawnBySoftware(): boolean {
  const context = document.createElement("canvas").getContext("webgl2");
  const information = context?.getExtension("WEBGL_debug_renderer_info");
  const name = information ? String(context?.getParameter(information.UNMASKED_RENDERER_WEBGL)) : "";
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

export const SEEN_DEG = 34;
const KEY_STEP_RAD = 0.12;
const KEY_ZOOM = 1.15;

interface EyeEvents {
  /** The eye is somewhere else. */
  moved: () => void;
  /** Whether the person turns the view now. */
  handled: (now: boolean) => void;
}

/** The eye of the person in the scene: turned by dragging, put to viewpoints, kept for the next time. */
export class Eye {
  readonly camera = new PerspectiveCamera(SEEN_DEG, 1, 1, 5000);
  #orbit: OrbitControls;

  constructor(
    private readonly element: HTMLElement,
    private readonly events: EyeEvents,
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

const SOFTWARE_PIXELS = 0.8; // of the pixels of the screen, each way
const BACKGROUND = 0x12161b; // --space of styles.css

interface Events {
  /** The person drags the probe to a pose. */
  moved: (pose: Pose) => void;
  /** The person drags the shape that is worked on to a place. */
  put: (place: Vector) => void;
  /** The person looks from somewhere else. */
  looked: (look: Look) => void;
  /** The person points twice at a place on the skin. */
  picked: (place: Vector) => void;
}

/** The scene in space: its Gaussians, the training planes, the skin, the probe with its live image. */
export class SpaceView {
  #renderer: WebGLRenderer;
  #scene = new Scene();
  #loop: DrawingLoop;
  #eye: Eye;
  #probe: ProbeHandle;
  #point: PointHandle;
  #image = new LiveImage();
  #imagePose: Pose | null = null;
  #tools = new ToolBodies();
  #toldTools = "";
  #cloud = new Cloud();
  #cutPlane = new Plane();
  #cut: Cut = { across: "image", at_mm: 0 };
  #form: Form | null = null;
  #sweep: Group | null = null;
  #outline: LineSegments | null = null;
  #skin: Mesh | null = null;
  #plan: LineSegments | null = null;
  #solids: Group | null = null;
  /** Whether the person has put the eye where it is. */
  #steers = false;

  /** Throws where the browser has no WebGL. */
  constructor(
    container: HTMLElement,
    private readonly events: Events,
  ) {
    const software = drawnBySoftware();
    this.#renderer = new WebGLRenderer({ antialias: !software });
    this.#renderer.localClippingEnabled = true;
    const { domElement } = this.#renderer;
    container.append(domElement);
    const context = this.#renderer.getContext() as WebGL2RenderingContext;
    this.#loop = new DrawingLoop(context, software, (scale) => this.#draw(scale), (band, bands) => this.#refine(band, bands));
    domElement.addEventListener("webglcontextrestored", this.#restored);
    domElement.addEventListener("dblclick", this.#pick);
    this.#eye = new Eye(domElement, {
      moved: () => {
        if (this.#steers) this.events.looked(this.#eye.look);
        this.#acted();
      },
      handled: (now) => (this.#loop.handled = now),
    });
    const handled = (now: boolean): void => {
      this.#loop.handled = now;
      this.#eye.enabled = !now;
    };
    const dragged = { changed: this.#acted, handled };
    this.#probe = new ProbeHandle(this.#eye.camera, domElement, { ...dragged, moved: (pose) => this.events.moved(pose) });
    this.#point = new PointHandle(this.#eye.camera, domElement, { ...dragged, moved: (place) => this.events.put(place) });
    this.#image.object.layers.enable(OCCLUDERS);
    const light = new DirectionalLight(0xffffff, 1.8);
    light.position.set(-0.5, 1, 1);
    this.#eye.camera.add(light);
    this.#scene.background = new Color(BACKGROUND);
    const lit = [new AmbientLight(0xffffff, 1.2), this.#eye.camera];
    this.#scene.add(...lit, this.#probe.object, this.#probe.helper, this.#image.object);
    this.#scene.add(this.#tools.object, this.#cloud.object, this.#point.object, this.#point.helper);
  }

  dispose(): void {
    this.#loop.stop();
    this.#probe.dispose();
    this.#point.dispose();
    this.#eye.dispose();
    this.#cloud.dispose();
    this.#image.dispose();
    this.#tools.dispose();
    for (const object of [this.#sweep, this.#outline, this.#skin, this.#plan, this.#solids]) if (object) drop(object);
    this.#renderer.domElement.removeEventListener("webglcontextrestored", this.#restored);
    this.#renderer.dispose();
    this.#renderer.domElement.remove();
  }

  resize(width: number, height: number): void {
    if (width === 0 || height === 0) return;
    this.#renderer.setPixelRatio(this.#loop.software ? SOFTWARE_PIXELS : Math.min(devicePixelRatio, 2));
    this.#renderer.setSize(width, height);
    this.#eye.resize(width / height);
    this.#acted();
  }

  /** The box that the scene fills, and the planes of its sweep. `filled`: whether they are more than outlines. */
  setSurroundings(box: Box, views: readonly Pose[], plane: ImagePlane, filled: boolean): void {
    const visible = this.#sweep?.visible ?? true;
    for (const object of [this.#sweep, this.#outline]) if (object) drop(object);
    this.#sweep = sweepPlanes(views, plane.lines_mm, this.#cutPlane, filled);
    this.#sweep.visible = visible;
    this.#outline = boxLines(box);
    this.#scene.add(this.#sweep, this.#outline);
    this.#acted();
  }

  showSweep(shown: boolean): void {
    if (this.#sweep) this.#sweep.visible = shown;
    this.#acted();
  }

  setSkin(skin: Skin | null): void {
    if (this.#skin) drop(this.#skin);
    this.#skin = skin && skinMesh(skin);
    if (this.#skin) this.#scene.add(this.#skin);
    this.#acted();
  }

  setPlan(views: readonly { pose: Pose; gain: number }[], plane: ImagePlane | null): void {
    if (this.#plan) drop(this.#plan);
    this.#plan = plane && plannedViews(views, plane);
    if (this.#plan) this.#scene.add(this.#plan);
    this.#acted();
  }

  /** Shapes of edits, and the one that is worked on; `isDragged`: whether a gizmo moves that. */
  setSolids(solids: readonly Solid[], held: Solid | null, isDragged: boolean): void {
    if (this.#solids) drop(this.#solids);
    this.#solids = solidBodies(solids, held);
    this.#scene.add(this.#solids);
    this.#point.put(isDragged && held !== null ? middleOf(held) : null);
    this.#acted();
  }

  setGaussians(gaussians: Gaussians | null): void {
    this.#cloud.setGaussians(gaussians);
    this.#acted();
  }

  setVolume(volume: Volume | null): void {
    this.#loop.forgetCost();
    this.#cloud.setVolume(volume);
    this.#acted();
  }

  setAppearance(appearance: Appearance): void {
    if (appearance.form !== this.#form) this.#loop.forgetCost();
    this.#form = appearance.form;
    this.#cloud.setAppearance(appearance);
    this.#acted();
  }

  setCut(cut: Cut): void {
    this.#cut = cut;
    this.#acted();
  }

  setGizmo(gizmo: Gizmo): void {
    this.#probe.setGizmo(gizmo);
    this.#acted();
  }

  /** The probe that is held, told by its image plane. */
  setProbe(plane: ImagePlane): void {
    this.#probe.setProbe(plane);
    this.#acted();
  }

  setPose(pose: Pose): void {
    this.#probe.setPose(pose);
    this.#tools.setPose(pose);
    this.#loop.touch("frame");
  }

  setTools(tools: readonly Tool[]): void {
    this.#tools.set(tools);
    this.#toldTools = JSON.stringify(tools);
    this.#acted();
  }

  setFrame(frame: Frame, placed: Placed): void {
    this.#image.set(frame, placed);
    this.#imagePose = frame.header.pose.flat();
    this.#loop.touch("frame");
  }

  /** Looks at all of a box. */
  lookFrom(viewpoint: Viewpoint, sides: Sides, box: Box): void {
    this.#steers = false;
    this.#eye.look = lookFrom(viewpoint, sides, box, SEEN_DEG, this.#eye.camera.aspect);
    this.#steers = true;
  }

  /** Looks from where the person has looked before. */
  lookAgain(look: Look): void {
    this.#steers = false;
    this.#eye.look = look;
    this.#steers = true;
  }

  /** Turns the view by a key; true where it is one of those. */
  press(key: string): boolean {
    return this.#eye.press(key);
  }

  #draw(scale: number): boolean {
    const drew = this.#cloud.draw(this.#sight(), scale);
    this.#renderer.render(this.#scene, this.#eye.camera);
    return drew;
  }

  #refine(band: number, bands: number): boolean {
    const drew = this.#cloud.refine(this.#sight(), band, bands);
    if (drew && band === bands - 1) this.#renderer.render(this.#scene, this.#eye.camera);
    return drew;
  }

  #sight(): Sight {
    const { camera } = this.#eye;
    camera.updateMatrixWorld();
    const image = this.#image.object.visible ? this.#imagePose : null;
    placeCut(this.#cutPlane, this.#cut, image, new Vector3().setFromMatrixPosition(camera.matrixWorld));
    const { position, quaternion } = this.#probe.object;
    const occludedBy = [...(image ?? []), ...position.toArray(), ...quaternion.toArray(), this.#toldTools].join();
    const sliced = this.#cut.across !== "image";
    return { renderer: this.#renderer, scene: this.#scene, camera, plane: this.#cutPlane, sliced, occludedBy };
  }

  /** What the person does is shown at once. */
  #acted = (): void => this.#loop.touch("person");

  #pick = (event: MouseEvent): void => {
    const [hit] = this.#skin ? pointedAt(event, this.#eye.camera).intersectObject(this.#skin) : [];
    if (hit) this.events.picked(hit.point.toArray());
  };

  #restored = (): void => {
    this.#cloud.forget();
    this.#loop.restart();
  };
}
