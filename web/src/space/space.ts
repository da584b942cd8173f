/** The scene in space: its Gaussians, the training planes, the skin, the probe with its live image. */

import {
  AmbientLight, Color, DirectionalLight, Group, type LineSegments, Mesh, Plane, Scene, Vector3, WebGLRenderer,
} from "three";

import type { ImagePlane, Tool } from "../api/contract";
import type { Gaussians } from "../api/gaussians";
import type { Frame } from "../api/stream";
import type { Placed } from "../geometry/plane";
import type { Pose, Vector } from "../geometry/pose";
import type { Skin } from "../geometry/skin";
import type { Appearance, Cut, Form } from "./appearance";
import { boxLines, drop, LiveImage, skinMesh, sweepPlanes, ToolBodies } from "./bodies";
import { Cloud, OCCLUDERS, type Sight } from "./cloud";
import { DrawingLoop, drawnBySoftware } from "./drawing";
import { Eye, placeCut, SEEN_DEG } from "./eye";
import { type Gizmo, pointedAt, ProbeHandle } from "./probe_handle";
import { type Box, type Look, lookFrom, type Sides, type Viewpoint } from "./viewpoints";
import type { Volume } from "./volume";

const SOFTWARE_PIXELS = 0.8; // of the pixels of the screen, each way
const BACKGROUND = 0x12161b; // --space of styles.css

interface Events {
  /** The person drags the probe to a pose. */
  moved: (pose: Pose) => void;
  /** The person looks from somewhere else. */
  looked: (look: Look) => void;
  /** The person points twice at a place on the skin. */
  picked: (place: Vector) => void;
}

export class SpaceView {
  #renderer: WebGLRenderer;
  #scene = new Scene();
  #loop: DrawingLoop;
  #eye: Eye;
  #probe: ProbeHandle;
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
    this.#probe = new ProbeHandle(this.#eye.camera, domElement, {
      changed: this.#acted,
      moved: (pose) => this.events.moved(pose),
      handled: (now) => {
        this.#loop.handled = now;
        this.#eye.enabled = !now;
      },
    });
    this.#image.object.layers.enable(OCCLUDERS);
    const light = new DirectionalLight(0xffffff, 1.8);
    light.position.set(-0.5, 1, 1);
    this.#eye.camera.add(light);
    this.#scene.background = new Color(BACKGROUND);
    const lit = [new AmbientLight(0xffffff, 1.2), this.#eye.camera];
    this.#scene.add(...lit, this.#probe.object, this.#probe.helper, this.#image.object);
    this.#scene.add(this.#tools.object, this.#cloud.object);
  }

  dispose(): void {
    this.#loop.stop();
    this.#probe.dispose();
    this.#eye.dispose();
    this.#cloud.dispose();
    this.#image.dispose();
    this.#tools.dispose();
    for (const object of [this.#sweep, this.#outline, this.#skin]) if (object) drop(object);
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
