/** The Gaussians in space: drawn into a picture of their own, as coarse as there is time for, that is laid over the rest. */

import {
  BufferAttribute, BufferGeometry, Color, DepthTexture, DoubleSide, Mesh, MeshBasicMaterial,
  type PerspectiveCamera, type Plane, Scene, type ShaderMaterial, type Texture, UnsignedIntType, Vector2,
  Vector3, type WebGLRenderer, WebGLRenderTarget,
} from "three";

import type { Gaussians } from "../api/gaussians";
import { type Appearance, middleOf, USUAL } from "./appearance";
import { cloudMaterial, cloudUniforms, fillPalette, fillShown, Splats, VolumeLayer } from "./cloud_layers";
import type { Volume } from "./volume";

/** The layer of what hides parts of the cloud: the image and the probe. */
export const OCCLUDERS = 1;

const OVER = `
varying vec2 place;
void main() {
  place = 0.5 * position.xy + 0.5;
  gl_Position = vec4(position.xy, 0.0, 1.0);
}`;
const LAID = `
uniform sampler2D picture;
varying vec2 place;
void main() { gl_FragColor = texture2D(picture, place); }`;

/** From where the cloud is looked at, and what cuts and hides it. */
export interface Sight {
  renderer: WebGLRenderer;
  scene: Scene;
  camera: PerspectiveCamera;
  plane: Plane;
  /** Whether the face of the cut is painted. */
  sliced: boolean;
  /** Where the things are that hide parts of it. */
  occludedBy: string;
}

/** Colours of the cloud, and the depths of the things around it. */
class Picture {
  readonly target = new WebGLRenderTarget(1, 1, { depthBuffer: false });
  readonly occluders = new WebGLRenderTarget(1, 1, { depthTexture: new DepthTexture(1, 1, UnsignedIntType) });
  /** What it shows; empty while it is drawn. */
  of = "";

  fit(width: number, height: number): void {
    if (this.target.width === width && this.target.height === height) return;
    this.target.setSize(width, height);
    this.occluders.setSize(width, height);
  }

  dispose(): void {
    this.occluders.depthTexture?.dispose();
    this.occluders.dispose();
    this.target.dispose();
  }
}

export class Cloud {
  /** Lays the picture over what was drawn before. */
  readonly object: Mesh<BufferGeometry, ShaderMaterial>;
  #uniforms = cloudUniforms();
  #laid: { value: Texture | null } = { value: null };
  #scene = new Scene();
  /** Drawn at once, and drawn band by band where there is time. */
  #coarse = new Picture();
  #fine = new Picture();
  #depthOnly = new MeshBasicMaterial({ colorWrite: false, side: DoubleSide });
  #appearance: Appearance = USUAL;
  #intensities: readonly [number, number] = [0, 1];
  #gaussians: Gaussians | null = null;
  #splats: Splats | null = null;
  #volumeData: Volume | null = null;
  #volume: VolumeLayer | null = null;
  #changes = 0;
  #towards = new Vector3();
  #sortedFor = new Vector3();

  constructor() {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
    this.object = new Mesh(geometry, cloudMaterial(OVER, LAID, { picture: this.#laid }));
    this.object.frustumCulled = false;
    this.object.renderOrder = 10;
    this.object.visible = false;
  }

  setGaussians(gaussians: Gaussians | null): void {
    this.#splats?.dispose();
    this.#splats = null;
    this.#gaussians = gaussians;
    if (gaussians) this.#intensities = middleOf(gaussians.column("intensity"));
    this.#update();
  }

  setVolume(volume: Volume | null): void {
    this.#volume?.dispose();
    this.#volume = null;
    this.#volumeData = volume;
    this.#update();
  }

  setAppearance(appearance: Appearance): void {
    this.#appearance = appearance;
    this.#update();
  }

  /** Draws the picture at a scale of the pixels of the screen, if it is another one than it was: true then. */
  draw(at: Sight, scale: number): boolean {
    if (!this.object.visible) return false;
    const wanted = this.#wanted(at);
    const known = [this.#fine, this.#coarse].find(({ of }) => of === wanted);
    const picture = known ?? this.#coarse;
    this.#laid.value = picture.target.texture;
    if (known) return false;
    this.#prepare(picture, at, scale);
    this.#paint(picture, at);
    picture.of = wanted;
    return true;
  }

  /** Draws one of so many bands of the fine picture; with the last one it is shown. False: nothing is to be drawn. */
  refine(at: Sight, band: number, bands: number): boolean {
    const wanted = this.#wanted(at);
    if (!this.object.visible || this.#fine.of === wanted) return false;
    const picture = this.#fine;
    if (band === 0) this.#prepare(picture, at, 1);
    const { target } = picture;
    const [from, to] = [band, band + 1].map((end) => Math.round((target.height * end) / bands)) as [number, number];
    target.scissor.set(0, from, target.width, to - from);
    target.scissorTest = true;
    this.#paint(picture, at);
    target.scissorTest = false;
    if (band < bands - 1) return true;
    picture.of = wanted;
    this.#laid.value = target.texture;
    return true;
  }

  dispose(): void {
    this.#splats?.dispose();
    this.#volume?.dispose();
    this.#coarse.dispose();
    this.#fine.dispose();
    this.#depthOnly.dispose();
    this.#uniforms.palette.value.dispose();
    this.#uniforms.shown.value.dispose();
    this.object.geometry.dispose();
    this.object.material.dispose();
  }

  /** Draws everything anew: the graphics card has lost its pictures. */
  forget(): void {
    this.#changes += 1;
  }

  /** What tells one picture from another. */
  #wanted({ renderer, camera, plane, sliced, occludedBy }: Sight): string {
    const size = renderer.getDrawingBufferSize(new Vector2());
    const numbers = [...camera.matrixWorld.elements, camera.aspect, camera.near, ...plane.normal.toArray(), plane.constant];
    return [this.#changes, size.x, size.y, sliced, occludedBy, ...numbers].join();
  }

  /** Fits the picture to the screen, and draws the depths of what hides parts of the cloud. */
  #prepare(picture: Picture, { renderer, scene, camera, plane, sliced }: Sight, scale: number): void {
    picture.of = "";
    const size = renderer.getDrawingBufferSize(new Vector2()).multiplyScalar(scale).ceil();
    picture.fit(size.x, size.y);
    this.#uniforms.cut.value.set(...plane.normal.toArray(), plane.constant);
    this.#uniforms.toScene.value.copy(camera.matrixWorld).multiply(camera.projectionMatrixInverse);
    this.#volume?.slice(sliced);
    if (this.#splats?.object.visible) this.#sort(camera);
    const { mask } = camera.layers;
    const { background } = scene;
    scene.background = null;
    scene.overrideMaterial = this.#depthOnly;
    camera.layers.set(OCCLUDERS);
    renderer.setRenderTarget(picture.occluders);
    renderer.render(scene, camera);
    renderer.setRenderTarget(null);
    camera.layers.mask = mask;
    scene.overrideMaterial = null;
    scene.background = background;
  }

  #paint({ target, occluders }: Picture, { renderer, camera }: Sight): void {
    this.#uniforms.view.value.set(target.width, target.height);
    this.#uniforms.occluders.value = occluders.depthTexture;
    const colour = renderer.getClearColor(new Color());
    const alpha = renderer.getClearAlpha();
    renderer.setClearColor(0x000000, 0);
    renderer.setRenderTarget(target);
    renderer.render(this.#scene, camera);
    renderer.setRenderTarget(null);
    renderer.setClearColor(colour, alpha);
  }

  /** Only where the eye went round so far that the order would show. */
  #sort(camera: PerspectiveCamera): void {
    camera.getWorldDirection(this.#towards);
    if (this.#towards.dot(this.#sortedFor) > 0.9995) return;
    this.#splats!.sort(camera, this.#sortedFor);
  }

  /** Makes what is needed for the form chosen, and tells it how to look. */
  #update(): void {
    const appearance = this.#appearance;
    const asSplats = appearance.form === "splats";
    if (asSplats && this.#splats === null && this.#gaussians !== null) {
      this.#splats = new Splats(this.#gaussians, this.#uniforms);
      this.#scene.add(this.#splats.object);
    }
    if (!asSplats && appearance.form !== "none" && this.#volume === null && this.#volumeData !== null) {
      this.#volume = new VolumeLayer(this.#volumeData, this.#uniforms);
      this.#scene.add(this.#volume.object);
    }
    if (this.#splats) {
      this.#splats.object.visible = asSplats;
      if (asSplats) this.#splats.set(appearance, this.#intensities, this.#volumeData);
      this.#sortedFor.set(0, 0, 0);
    }
    if (this.#volume) {
      this.#volume.object.visible = !asSplats && appearance.form !== "none";
      this.#volume.set(appearance);
    }
    fillPalette(this.#uniforms.palette.value, appearance.colour);
    fillShown(this.#uniforms.shown.value, appearance.hidden);
    this.#uniforms.opacity.value = appearance.opacity;
    this.#uniforms.threshold.value = appearance.threshold;
    this.#uniforms.size.value = appearance.size;
    this.object.visible = [this.#splats?.object, this.#volume?.object].some((object) => object?.visible);
    this.#changes += 1;
  }
}
