/** The volume, marched through along each line of sight. */

import {
  BufferAttribute,
  BufferGeometry,
  Data3DTexture,
  LinearFilter,
  Mesh,
  RGBAFormat,
  Vector3,
  type ShaderMaterial,
} from "three";

import type { Appearance, ColourBy, Form, SolidBy } from "./appearance";
import { cloudMaterial, type CloudUniforms } from "./cloud_material";
import { brightestOf, type Volume } from "./volume";

const COLOURS: Record<ColourBy, number> = { intensity: 0, coverage: 1, transmittance: 2, label: 3 };
const SOLIDS: Record<SolidBy, number> = { echo: 0, shadow: 1 };
const IS_MAXIMUM: Record<Form, boolean> = { shaded: false, maximum: true, splats: false, none: false };

const VERTEX = `
varying vec2 place;
void main() {
  place = position.xy;
  gl_Position = vec4(position.xy, 0.0, 1.0);
}`;
const FRAGMENT = `
precision highp sampler3D;
uniform sampler3D volume;
uniform sampler2D palette, shown, occluders;
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
    float strength = solid(v);
    along += stride;
    if (maximum) {
      if (strength > best && isShown(point)) { best = strength; bestPoint = point; found = true; }
      continue;
    }
    float alpha = alphaOf(strength);
    if (alpha < 0.02 || !isShown(point)) continue;
    vec3 e = vec3(stride, 0.0, 0.0);
    vec3 slope = vec3(
      solid(voxel(point + e.xyy)) - solid(voxel(point - e.xyy)),
      solid(voxel(point + e.yxy)) - solid(voxel(point - e.yxy)),
      solid(voxel(point + e.yyx)) - solid(voxel(point - e.yyx)));
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

export class VolumeLayer {
  readonly object: Mesh<BufferGeometry, ShaderMaterial>;
  #texture: Data3DTexture;
  #uniforms;

  constructor(volume: Volume, shared: CloudUniforms) {
    const { grid, voxels } = volume;
    this.#texture = new Data3DTexture(voxels, ...grid.size);
    this.#texture.format = RGBAFormat;
    this.#texture.minFilter = this.#texture.magFilter = LinearFilter;
    this.#texture.needsUpdate = true;
    const low = new Vector3(...grid.low);
    const high = new Vector3(...grid.size).multiplyScalar(grid.voxel_mm).add(low);
    this.#uniforms = {
      volume: { value: this.#texture },
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
    this.object = new Mesh(geometry, cloudMaterial(VERTEX, FRAGMENT, { ...shared, ...this.#uniforms }));
    this.object.frustumCulled = false;
  }

  set({ form, colour, solid }: Appearance): void {
    this.#uniforms.maximum.value = IS_MAXIMUM[form];
    this.#uniforms.colourBy.value = COLOURS[colour];
    this.#uniforms.solidBy.value = SOLIDS[solid];
  }

  /** Whether the face of the cut is painted: not where the image lies in it. */
  slice(sliced: boolean): void {
    this.#uniforms.sliced.value = sliced;
  }

  dispose(): void {
    this.#texture.dispose();
    this.object.geometry.dispose();
    this.object.material.dispose();
    this.object.removeFromParent();
  }
}
