/** The scene in space: Gaussians as points, training planes, the probe with its live image. Drawn only when it changes. */

import {
  AmbientLight,
  BufferAttribute,
  BufferGeometry,
  Color,
  DirectionalLight,
  Group,
  LineBasicMaterial,
  LineSegments,
  PerspectiveCamera,
  Plane,
  Scene,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { TransformControls } from "three/examples/jsm/controls/TransformControls.js";

import type { GaussianPoints } from "../api/scenes";
import type { Frame } from "../api/stream";
import type { Placed } from "../geometry/picture";
import type { ImagePlane } from "../geometry/plane";
import { axis, fromPositionQuaternion, IDENTITY, translated, type Pose } from "../geometry/pose";
import { drop } from "./drop";
import { LiveImage } from "./image_plane";
import { placeObject } from "./place";
import { PointCloud, type PointColour } from "./points";
import { probeBody } from "./probe_body";
import { sweepPlanes } from "./sweep";

const BUSY_SHARE = 0.3; // of the time, at most, goes into drawing: the live image comes first
const HANDLED_SHARE = 0.7; // while the person works in the view
const SOFTWARE_SHARE = 0.15; // where the processor draws
const SOFTWARE_PIXELS = 0.7; // of the pixels of the screen, each way
const BACKGROUND = 0x12161b; // --space of styles.css
const BOX_LINES = 0x6b7783;

export type Gizmo = "translate" | "rotate" | "none";

export class SpaceView {
  #renderer: WebGLRenderer;
  #scene = new Scene();
  #camera = new PerspectiveCamera(38, 1, 1, 5000);
  #orbit: OrbitControls;
  #gizmo: TransformControls;
  /** Lies in the middle of the face, about which the probe is turned. */
  #probe = new Group();
  #pose: Pose = IDENTITY;
  #pivotDepth_mm = 0;
  #image = new LiveImage();
  #sweep: Group | null = null;
  #points: PointCloud | null = null;
  #cut = true;
  #cutPlane = new Plane();
  #outline: LineSegments | null = null;
  #box: [Vector3, Vector3] = [new Vector3(-30, -30, 0), new Vector3(30, 30, 60)];
  #up = new Vector3(0, 0, -1);
  #dirty = true;
  #request = 0;
  #next_ms = 0;
  #started_ms = 0;
  #fence: WebGLSync | null = null;
  #looked = false;
  #software = drawnBySoftware();
  /** Whether the person turns the view, or drags the probe. */
  #handled = false;

  /** Throws where the browser has no WebGL. `moved` is told of poses that the person drags the probe to. */
  constructor(
    container: HTMLElement,
    private readonly moved: (pose: Pose) => void,
  ) {
    this.#renderer = new WebGLRenderer({ antialias: !this.#software });
    const { domElement } = this.#renderer;
    this.#renderer.localClippingEnabled = true;
    container.append(domElement);
    domElement.addEventListener("webglcontextrestored", this.#restored);
    this.#camera.up.copy(this.#up);
    this.#orbit = new OrbitControls(this.#camera, domElement);
    this.#orbit.addEventListener("change", this.#touch);
    this.#orbit.addEventListener("start", () => (this.#handled = true));
    this.#orbit.addEventListener("end", () => (this.#handled = false));
    this.#gizmo = new TransformControls(this.#camera, domElement);
    this.#gizmo.space = "local";
    this.#gizmo.size = 0.75;
    this.#gizmo.attach(this.#probe);
    this.#gizmo.addEventListener("change", this.#touch);
    this.#gizmo.addEventListener("dragging-changed", ({ value }) => {
      this.#orbit.enabled = value !== true;
      this.#handled = value === true;
    });
    this.#gizmo.addEventListener("axis-changed", ({ value }) => (domElement.style.cursor = value ? "grab" : ""));
    this.#gizmo.addEventListener("objectChange", () => this.#report());
    const light = new DirectionalLight(0xffffff, 1.8);
    light.position.set(-0.5, 1, 1);
    this.#camera.add(light);
    this.#scene.background = new Color(BACKGROUND);
    this.#scene.add(new AmbientLight(0xffffff, 1.2), this.#camera, this.#probe, this.#image.object, this.#gizmo.getHelper());
  }

  dispose(): void {
    cancelAnimationFrame(this.#request);
    this.#gizmo.dispose();
    this.#orbit.dispose();
    this.#points?.dispose();
    this.#image.dispose();
    for (const object of [this.#probe, this.#sweep, this.#outline]) if (object) drop(object);
    this.#renderer.domElement.removeEventListener("webglcontextrestored", this.#restored);
    this.#renderer.dispose();
    this.#renderer.domElement.remove();
  }

  resize(width: number, height: number): void {
    if (width === 0 || height === 0) return;
    this.#renderer.setPixelRatio(this.#software ? SOFTWARE_PIXELS : Math.min(devicePixelRatio, 2));
    this.#renderer.setSize(width, height);
    this.#camera.aspect = width / height;
    this.#camera.updateProjectionMatrix();
    this.#touch();
  }

  setGizmo(gizmo: Gizmo): void {
    const shown = gizmo !== "none";
    if (shown) this.#gizmo.setMode(gizmo);
    this.#gizmo.enabled = shown;
    this.#gizmo.getHelper().visible = shown;
    this.#touch();
  }

  /** The box that the scene fills, and its training views: they tell which way is up. */
  setSurroundings(low: readonly number[], high: readonly number[], views: readonly Pose[], plane: ImagePlane): void {
    const box: [Vector3, Vector3] = [new Vector3(...low), new Vector3(...high)];
    const same = this.#looked && box.every((corner, i) => corner.equals(this.#box[i]!));
    this.#box = box;
    const down = new Vector3();
    for (const view of views) down.add(new Vector3(...axis(view, 2)));
    if (down.length() > 1e-6) this.#up.copy(down.normalize().negate());
    this.#camera.up.copy(this.#up);
    const visible = this.#sweep?.visible ?? true;
    if (this.#sweep) drop(this.#sweep);
    this.#sweep = sweepPlanes(views, plane.lines_mm, this.#cutPlane);
    this.#sweep.visible = visible;
    this.#scene.add(this.#sweep, this.#boxLines());
    if (same) this.#touch();
    else this.lookFromOutside();
    this.#looked = true;
  }

  showSweep(shown: boolean): void {
    if (this.#sweep) this.#sweep.visible = shown;
    this.#touch();
  }

  setPoints(points: GaussianPoints | null): void {
    this.#points?.dispose();
    this.#points?.object.removeFromParent();
    this.#points = points && new PointCloud(points, this.#cutPlane);
    if (this.#points) this.#scene.add(this.#points.object);
    this.#touch();
  }

  /** Whether what lies between the eye and the image is left out. */
  cutAtImage(cut: boolean): void {
    this.#cut = cut;
    this.#touch();
  }

  colourPoints(colour: PointColour): void {
    if (this.#points) this.#points.colourBy(colour);
    this.#touch();
  }

  /** The probe that is held, told by its image plane. */
  setProbe(plane: ImagePlane): void {
    for (const body of [...this.#probe.children]) drop(body);
    this.#pivotDepth_mm = plane.pivot_depth_mm;
    const body = probeBody(plane);
    body.position.z = -this.#pivotDepth_mm;
    this.#probe.add(body);
    this.#place();
  }

  setPose(pose: Pose): void {
    this.#pose = pose;
    if (!this.#gizmo.dragging) this.#place();
  }

  #place(): void {
    placeObject(this.#probe, translated(this.#pose, [0, 0, this.#pivotDepth_mm]));
    this.#touch();
  }

  setFrame(frame: Frame, placed: Placed): void {
    this.#image.set(frame, placed);
    this.#touch();
  }

  /** From above and the side, so that all of the scene is seen. */
  lookFromOutside(): void {
    const [low, high] = this.#box;
    const centre = low.clone().add(high).multiplyScalar(0.5);
    const radius = high.distanceTo(low) / 2;
    const side = Math.abs(this.#up.x) < 0.9 ? new Vector3(1, 0, 0) : new Vector3(0, 1, 0);
    const front = new Vector3().crossVectors(side, this.#up).normalize();
    side.crossVectors(this.#up, front).normalize();
    const away = front.addScaledVector(side, 0.75).addScaledVector(this.#up, 0.6).normalize();
    const distance = (radius * 2.6) / Math.min(1, this.#camera.aspect);
    this.#camera.position.copy(centre).addScaledVector(away, distance);
    this.#camera.near = radius / 50;
    this.#camera.far = radius * 20;
    this.#camera.updateProjectionMatrix();
    this.#orbit.target.copy(centre);
    this.#orbit.update();
    this.#touch();
  }

  #boxLines(): LineSegments {
    if (this.#outline) drop(this.#outline);
    const [low, high] = this.#box;
    const corner = (bits: number): number[] => [
      bits & 1 ? high.x : low.x,
      bits & 2 ? high.y : low.y,
      bits & 4 ? high.z : low.z,
    ];
    const ends: number[] = [];
    for (let bits = 0; bits < 8; bits++)
      for (const bit of [1, 2, 4]) if (!(bits & bit)) ends.push(...corner(bits), ...corner(bits | bit));
    const geometry = new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(ends), 3));
    this.#outline = new LineSegments(
      geometry,
      new LineBasicMaterial({ color: BOX_LINES, transparent: true, opacity: 0.5 }),
    );
    return this.#outline;
  }

  /** Puts the cut into the plane of the image, the side away from the eye in front; or so that it cuts nothing. */
  #placeCut(): void {
    if (!this.#cut || !this.#image.object.visible) {
      this.#cutPlane.setComponents(0, 0, 0, 1);
      return;
    }
    const { position, quaternion } = this.#image.object;
    const normal = new Vector3(0, 1, 0).applyQuaternion(quaternion);
    if (normal.dot(this.#camera.position.clone().sub(position)) > 0) normal.negate();
    this.#cutPlane.setFromNormalAndCoplanarPoint(normal, position);
  }

  #report(): void {
    const { position: p, quaternion: q } = this.#probe;
    const face = fromPositionQuaternion([p.x, p.y, p.z], [q.w, q.x, q.y, q.z]);
    this.moved(translated(face, [0, 0, -this.#pivotDepth_mm]));
  }

  /** A fence of the context that was lost would never be signalled. */
  #restored = (): void => {
    this.#fence = null;
    this.#touch();
  };

  #touch = (): void => {
    this.#dirty = true;
    this.#ask();
  };

  #ask(): void {
    if (this.#request === 0) this.#request = requestAnimationFrame(this.#draw);
  }

  /** Draws if something changed, unless the drawing before is not done or has just taken its share of the time. */
  #draw = (now_ms: number): void => {
    this.#request = 0;
    if (this.#fence !== null) {
      if (!this.#finished(this.#fence)) return this.#ask();
      const taken_ms = performance.now() - this.#started_ms;
      this.#next_ms = this.#started_ms + taken_ms / this.#share();
    }
    if (!this.#dirty) return;
    if (now_ms < this.#next_ms) return this.#ask();
    this.#dirty = false;
    this.#placeCut();
    this.#started_ms = performance.now();
    this.#renderer.render(this.#scene, this.#camera);
    const context = this.#renderer.getContext() as WebGL2RenderingContext;
    this.#fence = context.fenceSync(context.SYNC_GPU_COMMANDS_COMPLETE, 0);
    context.flush();
    this.#ask();
  };

  /** Of the time that drawing may take. */
  #share(): number {
    if (this.#handled) return HANDLED_SHARE;
    return this.#software ? SOFTWARE_SHARE : BUSY_SHARE;
  }

  #finished(fence: WebGLSync): boolean {
    const context = this.#renderer.getContext() as WebGL2RenderingContext;
    if (context.getSyncParameter(fence, context.SYNC_STATUS) !== context.SIGNALED) return false;
    context.deleteSync(fence);
    this.#fence = null;
    return true;
  }
}

/** Whether the processor draws, for want of a graphics card. */
function drawnBySoftware(): boolean {
  const context = document.createElement("canvas").getContext("webgl2");
  const information = context?.getExtension("WEBGL_debug_renderer_info");
  const name = information ? String(context?.getParameter(information.UNMASKED_RENDERER_WEBGL)) : "";
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}
