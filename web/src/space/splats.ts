/** The Gaussians as splats: each an ellipse as large as it is, drawn from back to front. */

import { BufferAttribute, BufferGeometry, DynamicDrawUsage, Points, type Camera, type Vector3 } from "three";

import type { Gaussians } from "../api/gaussians";
import type { Appearance } from "./appearance";
import { cloudMaterial, type CloudUniforms } from "./cloud_material";
import { byteAt, covariancesOf, type Volume } from "./volume";

const CHANNEL_COVERAGE = 1;
const DEPTHS = 4096; // steps in which they are sorted

const VERTEX = `
attribute vec3 covarianceA; // xx, xy, xz
attribute vec3 covarianceB; // yy, yz, zz
attribute vec2 look; // colour, strength
uniform float size;
uniform vec4 cut;
uniform vec2 view; // of the target, pixels
varying vec3 conic;
varying float radius;
varying vec2 tint;
const float REACH = 2.3;
void main() {
  vec4 centre = viewMatrix * vec4(position, 1.0);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  gl_PointSize = 0.0;
  if (dot(cut.xyz, position) + cut.w < 0.0 || centre.z > -1.0) return;
  mat3 turn = mat3(viewMatrix);
  mat3 own = mat3(covarianceA, vec3(covarianceA.y, covarianceB.xy), vec3(covarianceA.z, covarianceB.yz));
  mat3 seen = turn * own * transpose(turn) * size * size;
  float focal = 0.5 * projectionMatrix[1][1] * view.y / -centre.z;
  vec2 lean = -centre.xy / centre.z;
  // J Σ Jᵀ of the projection, with a third of a pixel so that none falls between them
  vec3 rowX = focal * vec3(1.0, 0.0, lean.x), rowY = focal * vec3(0.0, 1.0, lean.y);
  float a = dot(rowX, seen * rowX) + 0.33, b = dot(rowX, seen * rowY), c = dot(rowY, seen * rowY) + 0.33;
  float middle = 0.5 * (a + c);
  radius = min(180.0, REACH * sqrt(middle + sqrt(max(0.0, middle * middle - a * c + b * b))));
  conic = vec3(c, -b, a) / (a * c - b * b);
  tint = look;
  gl_PointSize = 2.0 * radius;
  gl_Position = projectionMatrix * centre;
}`;
const FRAGMENT = `
uniform sampler2D palette;
uniform sampler2D occluders;
uniform vec2 view;
uniform float opacity;
varying vec3 conic;
varying float radius;
varying vec2 tint;
void main() {
  if (texture2D(occluders, gl_FragCoord.xy / view).r < gl_FragCoord.z) discard;
  vec2 from = (gl_PointCoord - 0.5) * vec2(2.0, -2.0) * radius;
  float q = conic.x * from.x * from.x + 2.0 * conic.y * from.x * from.y + conic.z * from.y * from.y;
  float alpha = opacity * tint.y * exp(-0.5 * q);
  if (q > 5.3 || alpha < 0.01) discard;
  float light = 0.72 + 0.28 * exp(-0.5 * q);
  gl_FragColor = vec4(texture2D(palette, vec2(tint.x, 0.5)).rgb * light * alpha, alpha);
}`;

export class Splats {
  readonly object: Points<BufferGeometry>;
  #positions: Float32Array;
  #look: Uint8Array;
  #order: Uint32Array;
  /** Those that the threshold and the labels leave. */
  #chosen = new Uint32Array();

  constructor(
    private readonly gaussians: Gaussians,
    uniforms: CloudUniforms,
  ) {
    const { count } = gaussians;
    const [x, y, z] = (["x", "y", "z"] as const).map((name) => gaussians.column(name)) as Float32Array[];
    this.#positions = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) this.#positions.set([x![i]!, y![i]!, z![i]!], 3 * i);
    const covariances = covariancesOf(gaussians);
    const half = (first: number): Float32Array =>
      Float32Array.from({ length: 3 * count }, (_, i) => covariances[6 * Math.floor(i / 3) + first + (i % 3)]!);
    this.#look = new Uint8Array(2 * count);
    this.#order = new Uint32Array(count);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(this.#positions, 3));
    geometry.setAttribute("covarianceA", new BufferAttribute(half(0), 3));
    geometry.setAttribute("covarianceB", new BufferAttribute(half(3), 3));
    geometry.setAttribute("look", new BufferAttribute(this.#look, 2, true));
    geometry.setIndex(new BufferAttribute(this.#order, 1).setUsage(DynamicDrawUsage));
    this.object = new Points(geometry, cloudMaterial(VERTEX, FRAGMENT, uniforms));
    this.object.frustumCulled = false;
  }

  /** Takes colours and opacities; `low` and `high`: of the intensities. */
  set({ colour, solid, threshold, hidden }: Appearance, [low, high]: readonly [number, number], volume: Volume | null): void {
    const intensity = this.gaussians.column("intensity");
    const transmittance = this.gaussians.column("transmittance");
    const label = this.gaussians.column("label");
    const value = (i: number): number => {
      if (colour === "label") return label[i]! / 255;
      if (colour === "transmittance") return transmittance[i]!;
      if (colour === "intensity") return (intensity[i]! - low) / (high - low);
      const [x, y, z] = this.#positions.subarray(3 * i, 3 * i + 3);
      return volume === null ? 1 : byteAt(volume, x!, y!, z!, CHANNEL_COVERAGE) / 255;
    };
    const chosen: number[] = [];
    for (let i = 0; i < this.gaussians.count; i++) {
      const strength = solid === "shadow" ? 1 - transmittance[i]! : (intensity[i]! - low) / (high - low);
      if (strength < threshold || hidden.includes(label[i]!)) continue;
      chosen.push(i);
      const share = Math.min(1, 0.35 + (0.65 * (strength - threshold)) / Math.max(0.05, 1 - threshold));
      this.#look[2 * i] = 255 * Math.max(0, Math.min(1, value(i)));
      this.#look[2 * i + 1] = 255 * share;
    }
    this.#chosen = Uint32Array.from(chosen);
    this.object.geometry.attributes.look!.needsUpdate = true;
  }

  /** Puts those farthest from the eye first. */
  sort(camera: Camera, towards: Vector3): void {
    camera.getWorldDirection(towards);
    const { x, y, z } = towards;
    const depths = new Float32Array(this.#chosen.length);
    let [least, most] = [Infinity, -Infinity];
    for (const [at, i] of this.#chosen.entries()) {
      const depth = x * this.#positions[3 * i]! + y * this.#positions[3 * i + 1]! + z * this.#positions[3 * i + 2]!;
      depths[at] = depth;
      least = Math.min(least, depth);
      most = Math.max(most, depth);
    }
    const scale = (DEPTHS - 1) / Math.max(1e-6, most - least);
    const starts = new Uint32Array(DEPTHS + 1);
    for (const depth of depths) starts[DEPTHS - (((depth - least) * scale) | 0)]! += 1;
    for (let bin = 1; bin <= DEPTHS; bin++) starts[bin]! += starts[bin - 1]!;
    for (let at = depths.length - 1; at >= 0; at--) {
      const bin = DEPTHS - (((depths[at]! - least) * scale) | 0);
      this.#order[--starts[bin]!] = this.#chosen[at]!;
    }
    this.object.geometry.index!.needsUpdate = true;
    this.object.geometry.setDrawRange(0, this.#chosen.length);
  }

  dispose(): void {
    this.object.geometry.dispose();
    this.object.material instanceof Array || this.object.material.dispose();
    this.object.removeFromParent();
  }
}
