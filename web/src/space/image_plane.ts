/** The live image in its plane, at the pose that it was rendered at. */

import {
  BufferAttribute,
  BufferGeometry,
  DataTexture,
  DoubleSide,
  LinearFilter,
  Mesh,
  RedFormat,
  ShaderMaterial,
  UnsignedByteType,
} from "three";

import { outputPixels, type Frame } from "../api/stream";
import type { Placed } from "../geometry/picture";
import { placeObject } from "./place";
import { planeShape, textureCoordinates } from "./shapes";

const VERTEX = `
varying vec2 place;
void main() {
  place = uv;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`;
const FRAGMENT = `
uniform sampler2D image;
varying vec2 place;
void main() {
  gl_FragColor = vec4(vec3(texture2D(image, place).r), 0.96);
}`;

export class LiveImage {
  readonly object: Mesh<BufferGeometry, ShaderMaterial>;
  #texture: DataTexture | null = null;
  #placed: Placed | null = null;

  constructor() {
    const material = new ShaderMaterial({
      uniforms: { image: { value: null } },
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      side: DoubleSide,
      transparent: true,
    });
    this.object = new Mesh(new BufferGeometry(), material);
    this.object.visible = false;
    this.object.frustumCulled = false;
  }

  set(frame: Frame, placed: Placed): void {
    const { header } = frame;
    const pixels = outputPixels(frame, "bmode");
    if (pixels === undefined) return;
    if (placed !== this.#placed) this.#fitTo(placed, pixels);
    this.#texture!.image = { data: pixels as Uint8Array<ArrayBuffer>, width: header.width, height: header.height };
    this.#texture!.needsUpdate = true;
    placeObject(this.object, header.pose.flat());
    this.object.visible = true;
  }

  dispose(): void {
    this.#texture?.dispose();
    this.object.geometry.dispose();
    this.object.material.dispose();
  }

  /** A texture and a plane for frames of that size and place. */
  #fitTo(placed: Placed, pixels: Uint8Array): void {
    this.#placed = placed;
    this.#texture?.dispose();
    this.#texture = new DataTexture(pixels as Uint8Array<ArrayBuffer>, placed.width, placed.height, RedFormat, UnsignedByteType);
    this.#texture.minFilter = this.#texture.magFilter = LinearFilter;
    this.#texture.unpackAlignment = 1;
    this.object.material.uniforms.image!.value = this.#texture;
    const shape = planeShape(placed.lines);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(shape.positions, 3));
    geometry.setAttribute("uv", new BufferAttribute(textureCoordinates(placed), 2));
    geometry.setIndex(shape.indices);
    this.object.geometry.dispose();
    this.object.geometry = geometry;
  }
}
