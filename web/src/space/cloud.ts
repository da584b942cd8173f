/** The Gaussians in space: drawn into a picture of their own, as coarse as there is time for, that is laid over the rest. */

import {
  BufferAttribute,
  BufferGeometry,
  Color,
  DepthTexture,
  DoubleSide,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  Scene,
  UnsignedIntType,
  Vector2,
  Vector3,
  WebGLRenderTarget,
  type PerspectiveCamera,
  type Plane,
  type ShaderMaterial,
  type WebGLRenderer,
} from "three";

import type { Gaussians } from "../api/gaussians";
import { USUAL, type Appearance } from "./appearance";
import { cloudMaterial, cloudUniforms } from "./cloud_material";
import { middleOf } from "./middle";
import { fillPalette, fillShown } from "./palette";
import { Splats } from "./splats";
import type { Volume } from "./volume";
import { VolumeLayer } from "./volume_layer";

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

export class Cloud {
  /** Lays the picture over what was drawn before. */
  readonly object: Mesh<BufferGeometry, ShaderMaterial>;
  #uniforms = cloudUniforms();
  #scene = new Scene();
  #picture = new WebGLRenderTarget(1, 1, { depthBuffer: false });
  #occluders = new WebGLRenderTarget(1, 1, { depthTexture: new DepthTexture(1, 1, UnsignedIntType) });
  #depthOnly = new MeshBasicMaterial({ colorWrite: false, side: DoubleSide });
  #appearance: Appearance = USUAL;
  #intensities: readonly [number, number] = [0, 1];
  #gaussians: Gaussians | null = null;
  #splats: Splats | null = null;
  #volumeData: Volume | null = null;
  #volume: VolumeLayer | null = null;
  /** What the picture was drawn for. */
  #drawnFor = "";
  #changes = 0;
  #towards = new Vector3();
  #sortedFor = new Vector3();

  constructor() {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
    this.object = new Mesh(geometry, cloudMaterial(OVER, LAID, { picture: { value: this.#picture.texture } }));
    this.object.frustumCulled = false;
    this.object.renderOrder = 10;
    this.object.visible = false;
    this.#uniforms.occluders.value = this.#occluders.depthTexture;
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

  /** Draws the picture, if it is another one than it was: true then. `scale`: of the pixels of the screen, each way. */
  draw(
    renderer: WebGLRenderer,
    scene: Scene,
    camera: PerspectiveCamera,
    { plane, sliced, occludedBy }: { plane: Plane; sliced: boolean; occludedBy: string },
    scale: number,
  ): boolean {
    if (!this.object.visible) return false;
    const size = renderer.getDrawingBufferSize(new Vector2()).multiplyScalar(scale).ceil();
    const cut = [...plane.normal.toArray(), plane.constant] as const;
    const numbers = [...camera.matrixWorld.elements, camera.aspect, camera.near, ...cut];
    const wanted = [this.#changes, size.x, size.y, occludedBy, ...numbers].join();
    if (wanted === this.#drawnFor) return false;
    this.#drawnFor = wanted;
    if (this.#picture.width !== size.x || this.#picture.height !== size.y) {
      this.#picture.setSize(size.x, size.y);
      this.#occluders.setSize(size.x, size.y);
    }
    this.#uniforms.view.value.copy(size);
    this.#uniforms.cut.value.set(...cut);
    this.#uniforms.toScene.value.copy(camera.matrixWorld).multiply(new Matrix4().copy(camera.projectionMatrixInverse));
    this.#volume?.slice(sliced);
    if (this.#splats?.object.visible) this.#sort(camera);
    this.#drawOccluders(renderer, scene, camera);
    const colour = renderer.getClearColor(new Color());
    const alpha = renderer.getClearAlpha();
    renderer.setClearColor(0x000000, 0);
    renderer.setRenderTarget(this.#picture);
    renderer.render(this.#scene, camera);
    renderer.setRenderTarget(null);
    renderer.setClearColor(colour, alpha);
    return true;
  }

  dispose(): void {
    this.#splats?.dispose();
    this.#volume?.dispose();
    this.#picture.dispose();
    this.#occluders.depthTexture?.dispose();
    this.#occluders.dispose();
    this.#depthOnly.dispose();
    this.#uniforms.palette.value.dispose();
    this.#uniforms.shown.value.dispose();
    this.object.geometry.dispose();
    this.object.material.dispose();
  }

  #drawOccluders(renderer: WebGLRenderer, scene: Scene, camera: PerspectiveCamera): void {
    const { mask } = camera.layers;
    const { background } = scene;
    scene.background = null;
    scene.overrideMaterial = this.#depthOnly;
    camera.layers.set(OCCLUDERS);
    renderer.setRenderTarget(this.#occluders);
    renderer.render(scene, camera);
    camera.layers.mask = mask;
    scene.overrideMaterial = null;
    scene.background = background;
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
