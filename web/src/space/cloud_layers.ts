/** The Gaussians as shaders draw them: as splats, from back to front, or as a volume that lines of sight march through. */

import {
  BufferAttribute, BufferGeometry, type Camera, CustomBlending, Data3DTexture, DataTexture, DynamicDrawUsage,
  LinearFilter, Matrix4, Mesh, NearestFilter, OneFactor, OneMinusSrcAlphaFactor, Points, RGBAFormat,
  ShaderMaterial, type Texture, Vector2, Vector3, Vector4,
} from "three";

import type { Gaussians } from "../api/gaussians";
import { type Appearance, type ColourBy, colourOf, ENTRIES, type Form, type SolidBy } from "./appearance";
import { brightestOf, byteAt, covariancesOf, smallLabels, type Volume } from "./volume";

/** RGBA by share. */
export function paletteTexture(): DataTexture {
  const texture = new DataTexture(new Uint8Array(4 * ENTRIES), ENTRIES, 1);
  texture.minFilter = texture.magFilter = NearestFilter;
  return texture;
}

export function fillPalette(texture: DataTexture, by: ColourBy): void {
  const data = texture.image.data as Uint8Array;
  for (let entry = 0; entry < ENTRIES; entry++) data.set([...colourOf(by, entry / (ENTRIES - 1)), 255], 4 * entry);
  texture.needsUpdate = true;
}

/** For each label, whether it is shown, in the red of a texel. */
export function fillShown(texture: DataTexture, hidden: readonly number[]): void {
  const data = texture.image.data as Uint8Array;
  for (let label = 0; label < ENTRIES; label++) data[4 * label] = hidden.includes(label) ? 0 : 255;
  texture.needsUpdate = true;
}

export interface CloudUniforms {
  palette: { value: DataTexture };
  /** Which labels are shown. */
  shown: { value: DataTexture };
  /** Depths of what is no cloud. */
  occluders: { value: Texture | null };
  /** Size of the target, pixels. */
  view: { value: Vector2 };
  /** A point is left out where dot(cut.xyz, point) + cut.w < 0. */
  cut: { value: Vector4 };
  opacity: { value: number };
  threshold: { value: number };
  size: { value: number };
  /** From the screen to the scene. */
  toScene: { value: Matrix4 };
}

export function cloudUniforms(): CloudUniforms {
  return {
    palette: { value: paletteTexture() },
    shown: { value: paletteTexture() },
    occluders: { value: null },
    view: { value: new Vector2(1, 1) },
    cut: { value: new Vector4(0, 0, 0, 1) },
    opacity: { value: 1 },
    threshold: { value: 0 },
    size: { value: 1 },
    toScene: { value: new Matrix4() },
  };
}

/** Colours are multiplied by their opacity already. */
export function cloudMaterial(vertexShader: string, fragmentShader: string, uniforms: object): ShaderMaterial {
  return new ShaderMaterial({
    uniforms: uniforms as ShaderMaterial["uniforms"],
    vertexShader,
    fragmentShader,
    transparent: true,
    depthTest: false,
    depthWrite: false,
    blending: CustomBlending,
    blendSrc: OneFactor,
    blendDst: OneMinusSrcAlphaFactor,
  });
}

const CHANNEL_COVERAGE = 1;
const DEPTHS = 4096; // steps in which they are sorted

const SPLAT_VERTEX = `
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
const SPLAT_FRAGMENT = `
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

/** The Gaussians as splats: each an ellipse as large as it is, drawn from back to front. */
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
    this.object = new Points(geometry, cloudMaterial(SPLAT_VERTEX, SPLAT_FRAGMENT, uniforms));
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
    const small = volume === null ? [] : smallLabels(volume);
    for (let i = 0; i < this.gaussians.count; i++) {
      const strength = small.includes(label[i]!) ? 1 : solid === "shadow" ? 1 - transmittance[i]! : (intensity[i]! - low) / (high - low);
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

const COLOUR_NUMBERS: Record<ColourBy, number> = { intensity: 0, coverage: 1, transmittance: 2, label: 3 };
const SOLID_NUMBERS: Record<SolidBy, number> = { echo: 0, shadow: 1 };
const IS_MAXIMUM: Record<Form, boolean> = { shaded: false, maximum: true, splats: false, none: false };

const VOLUME_VERTEX = `
varying vec2 place;
void main() {
  place = position.xy;
  gl_Position = vec4(position.xy, 0.0, 1.0);
}`;
const VOLUME_FRAGMENT = `
precision highp sampler3D;
uniform sampler3D volume;
uniform sampler2D palette, shown, massive, occluders;
uniform mat4 toScene;
uniform vec2 view;
uniform vec3 low, high;
uniform vec4 cut;
uniform float opacity, threshold, stride, brightest;
uniform int colourBy, solidBy;
uniform bool maximum, sliced;
varying vec2 place;

const int MOST_STEPS = 640;

vec3 at(vec2 screen, float depth) {
  vec4 point = toScene * vec4(screen, 2.0 * depth - 1.0, 1.0);
  return point.xyz / point.w;
}
vec4 voxel(vec3 point) { return texture(volume, (point - low) / (high - low)); }
float labelOf(vec3 point) {
  ivec3 size = textureSize(volume, 0);
  return texelFetch(volume, clamp(ivec3(vec3(size) * (point - low) / (high - low)), ivec3(0), size - 1), 0).a;
}
float solid(vec4 v) { return solidBy == 1 ? v.b : min(1.0, v.r / brightest); }
bool isShown(vec3 point) { return texelFetch(shown, ivec2(int(255.0 * labelOf(point) + 0.5), 0), 0).r > 0.5; }
/** Small things are as solid as they are covered: vessels are shown as tubes. */
float solidAt(vec3 point) {
  vec4 v = voxel(point);
  bool small = texelFetch(massive, ivec2(int(255.0 * labelOf(point) + 0.5), 0), 0).r < 0.5;
  return small ? max(solid(v), v.g) : solid(v);
}
vec3 colour(vec4 v, vec3 point) {
  float value = v.r / brightest;
  if (colourBy == 1) value = v.g;
  else if (colourBy == 2) value = 1.0 - v.b / max(v.g, 0.004);
  else if (colourBy == 3) return texelFetch(palette, ivec2(int(255.0 * labelOf(point) + 0.5), 0), 0).rgb;
  return texture(palette, vec2(clamp(value, 0.002, 0.998), 0.5)).rgb;
}
/** 0 below the threshold, and rising from there. */
float alphaOf(float strength) { return smoothstep(threshold - 0.06, threshold + 0.06, strength); }

void main() {
  vec3 eye = at(place, 0.0);
  vec3 end = at(place, texture(occluders, gl_FragCoord.xy / view).r);
  vec3 way = normalize(end - eye);
  vec3 a = (low - eye) / way, b = (high - eye) / way;
  vec3 nearest = min(a, b), farthest = max(a, b);
  float from = max(max(nearest.x, nearest.y), max(nearest.z, 0.0));
  float to = min(min(farthest.x, farthest.y), min(farthest.z, distance(end, eye)));
  float fall = dot(cut.xyz, way), over = dot(cut.xyz, eye) + cut.w;
  bool cuts = false;
  if (fall != 0.0) {
    float crossing = -over / fall;
    if (fall > 0.0 && crossing > from) { from = crossing; cuts = true; }
    if (fall < 0.0) to = min(to, crossing);
  }
  if (from >= to) discard;
  vec4 sum = vec4(0.0);
  if (cuts && sliced) { // the face of the cut shows the echo that lies there
    vec3 point = eye + way * from;
    vec4 v = voxel(point);
    float cover = 0.9 * smoothstep(0.1, 0.5, v.g);
    sum = vec4((colourBy == 3 ? colour(v, point) * (0.35 + v.r) : vec3(v.r / brightest)) * cover, cover);
  }
  float noise = fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(0.06711056, 0.00583715))));
  float along = from + stride * noise;
  float best = threshold;
  vec3 bestPoint = vec3(0.0);
  bool found = false;
  for (int i = 0; i < MOST_STEPS; i++) {
    if (along >= to || sum.a > 0.97) break;
    vec3 point = eye + way * along;
    vec4 v = voxel(point);
    along += stride;
    float strength = maximum ? solid(v) : solidAt(point);
    if (maximum) {
      if (strength > best && isShown(point)) { best = strength; bestPoint = point; found = true; }
      continue;
    }
    float alpha = alphaOf(strength);
    if (alpha < 0.02 || !isShown(point)) continue;
    vec3 e = vec3(stride, 0.0, 0.0);
    vec3 slope = vec3(
      solidAt(point + e.xyy) - solidAt(point - e.xyy),
      solidAt(point + e.yxy) - solidAt(point - e.yxy),
      solidAt(point + e.yyx) - solidAt(point - e.yyx));
    float facing = length(slope) < 0.02 ? 0.7 : abs(dot(normalize(slope), way));
    float light = 0.28 + 0.72 * facing;
    alpha *= opacity;
    sum += (1.0 - sum.a) * alpha * vec4(colour(v, point) * light, 1.0);
  }
  if (maximum && found) {
    float alpha = opacity * smoothstep(threshold, threshold + 0.15, best);
    sum += (1.0 - sum.a) * alpha * vec4(colour(voxel(bestPoint), bestPoint) * (0.25 + 0.75 * best), 1.0);
  }
  gl_FragColor = sum;
}`;

/** The volume, marched through along each line of sight. */
export class VolumeLayer {
  readonly object: Mesh<BufferGeometry, ShaderMaterial>;
  #texture: Data3DTexture;
  /** The labels that are not small. */
  #massive = paletteTexture();
  #uniforms;

  constructor(volume: Volume, shared: CloudUniforms) {
    const { grid, voxels } = volume;
    this.#texture = new Data3DTexture(voxels, ...grid.size);
    this.#texture.format = RGBAFormat;
    this.#texture.minFilter = this.#texture.magFilter = LinearFilter;
    this.#texture.needsUpdate = true;
    fillShown(this.#massive, smallLabels(volume));
    const low = new Vector3(...grid.low);
    const high = new Vector3(...grid.size).multiplyScalar(grid.voxel_mm).add(low);
    this.#uniforms = {
      volume: { value: this.#texture },
      massive: { value: this.#massive },
      low: { value: low },
      high: { value: high },
      stride: { value: grid.voxel_mm },
      brightest: { value: brightestOf(volume) },
      colourBy: { value: 0 },
      solidBy: { value: 0 },
      maximum: { value: false },
      sliced: { value: false },
    };
    const geometry = new BufferGeometry(); // one triangle over the whole screen
    geometry.setAttribute("position", new BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
    this.object = new Mesh(geometry, cloudMaterial(VOLUME_VERTEX, VOLUME_FRAGMENT, { ...shared, ...this.#uniforms }));
    this.object.frustumCulled = false;
  }

  set({ form, colour, solid }: Appearance): void {
    this.#uniforms.maximum.value = IS_MAXIMUM[form];
    this.#uniforms.colourBy.value = COLOUR_NUMBERS[colour];
    this.#uniforms.solidBy.value = SOLID_NUMBERS[solid];
  }

  /** Whether the face of the cut is painted: not where the image lies in it. */
  slice(sliced: boolean): void {
    this.#uniforms.sliced.value = sliced;
  }

  dispose(): void {
    this.#texture.dispose();
    this.#massive.dispose();
    this.object.geometry.dispose();
    this.object.material.dispose();
    this.object.removeFromParent();
  }
}
