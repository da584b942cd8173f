/** What is drawn in space beside the Gaussians, as objects of three.js: box, sweep, skin, live image, probe, tools. */

import {
  BoxGeometry, BufferAttribute, BufferGeometry, Color, CylinderGeometry, DataTexture, DoubleSide, Group, InstancedMesh,
  LinearFilter, LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial, MeshLambertMaterial,
  type Object3D, type Plane, RedFormat, ShaderMaterial, SphereGeometry, UnsignedByteType, Vector3,
} from "three";

import type { ImagePlane, Tool } from "../api/contract";
import { type Frame, outputPixels } from "../api/stream";
import { areAllAround, boxOf, type Line, pixelAt, type Placed, shortened } from "../geometry/plane";
import { length, minus, type Pose, type Vector } from "../geometry/pose";
import { middleOf, poseOfEllipsoid, type Solid } from "../geometry/shapes";
import type { Skin } from "../geometry/skin";
import { isRod, lengthOf, poseOfBox } from "../geometry/tool_place";
import { type Box, corners } from "./appearance";
import { OCCLUDERS } from "./cloud";

/** The pose as a matrix of three.js. */
export function matrixOf(pose: Pose): Matrix4 {
  return new Matrix4().set(...(pose as Parameters<Matrix4["set"]>));
}

/** Puts an object where a probe of that pose is. */
export function placeObject(object: Object3D, pose: Pose): void {
  const matrix = matrixOf(pose);
  object.position.setFromMatrixPosition(matrix);
  object.quaternion.setFromRotationMatrix(matrix);
}

/** Removes an object, and frees what it and all within it hold on the graphics card. */
export function drop(object: Object3D): void {
  object.traverse((part) => {
    if (!(part instanceof Mesh || part instanceof LineSegments)) return;
    part.geometry.dispose();
    for (const material of [part.material].flat()) material.dispose();
    if (part instanceof InstancedMesh) part.dispose();
  });
  object.removeFromParent();
}

export interface Shape {
  /** x, y, z of each corner: of each line, where it begins and where it ends. */
  positions: Float32Array;
  /** Triangles. */
  indices: number[];
  /** Pairs of corners. */
  outline: number[];
}

export function planeShape(lines: readonly Line[]): Shape {
  const last = 2 * (lines.length - 1);
  const indices: number[] = [];
  const outline: number[] = areAllAround(lines) ? [] : [0, 1, last, last + 1];
  for (let first = 0; first < last; first += 2) {
    indices.push(first, first + 1, first + 2, first + 2, first + 1, first + 3);
    outline.push(first, first + 2, first + 1, first + 3);
  }
  const positions = new Float32Array(lines.flatMap(([x0, z0, x1, z1]) => [x0, 0, z0, x1, 0, z1]));
  return { positions, indices, outline };
}

/** Where each corner of the plane of a picture lies in its texture, 0 to 1, the first row at v = 0. */
export function textureCoordinates(placed: Placed): Float32Array {
  const { lines, width, height, picture, isStored } = placed;
  const corners = lines.flatMap(([x0, z0, x1, z1], index) => {
    if (isStored) {
      const share = index / (lines.length - 1);
      const u = picture.step[0] < 0 ? 1 - share : share;
      return [u, 0, u, 1];
    }
    return [{ x_mm: x0, z_mm: z0 }, { x_mm: x1, z_mm: z1 }].flatMap((end) => {
      const { column, row } = pixelAt(placed, end);
      return [(column + 0.5) / width, (row + 0.5) / height];
    });
  });
  return new Float32Array(corners);
}

const BOX_COLOUR = 0x6b7783;

export function boxLines(box: Box): LineSegments {
  const points = corners(box);
  const ends = points.flatMap((from, i) => [1, 2, 4].flatMap((bit) => (i & bit ? [] : [...from, ...points[i | bit]!])));
  const geometry = new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(ends), 3));
  return new LineSegments(geometry, new LineBasicMaterial({ color: BOX_COLOUR, transparent: true, opacity: 0.45 }));
}

const MOST_PLANES = 40; // more would only be a solid block
const SWEEP_COLOUR = 0x3d9ac4;

/** At most MOST_PLANES of the poses, evenly taken; `cut` leaves out what of the planes lies behind it.
 *
 * `filled`: whether they are more than outlines, which costs much where the processor draws.
 */
export function sweepPlanes(poses: readonly Pose[], lines: readonly Line[], cut: Plane, filled: boolean): Group {
  const step = Math.max(1, Math.ceil(poses.length / MOST_PLANES));
  const shown = poses.filter((_, index) => index % step === 0);
  const shape = planeShape(lines);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(shape.positions, 3));
  geometry.setIndex(shape.indices);
  const fill = new MeshBasicMaterial({
    color: SWEEP_COLOUR,
    transparent: true,
    opacity: 0.035,
    side: DoubleSide,
    depthWrite: false,
    clippingPlanes: [cut],
  });
  const planes = new InstancedMesh(geometry, fill, shown.length);
  planes.frustumCulled = false;
  const ends: number[] = [];
  for (const [index, pose] of shown.entries()) {
    const matrix = matrixOf(pose);
    planes.setMatrixAt(index, matrix);
    for (const corner of shape.outline)
      ends.push(...new Vector3().fromArray(shape.positions, corner * 3).applyMatrix4(matrix).toArray());
  }
  const outlines = new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(ends), 3));
  const stroke = new LineBasicMaterial({ color: SWEEP_COLOUR, transparent: true, opacity: 0.28 });
  planes.visible = filled;
  return new Group().add(planes, new LineSegments(outlines, stroke));
}

const PLAN_COLOURS = [new Color(0x6b4a86), new Color(0xf4d35e)] as const; // of the smallest and the largest gain
const FAN_SHARE = 0.25; // of the depth: whole images would hide each other

/** Views of a plan as little fans, the brighter the more they gain, and the way from face to face. */
export function plannedViews(views: readonly { pose: Pose; gain: number }[], plane: ImagePlane): LineSegments {
  const shape = planeShape(shortened(plane.lines_mm, FAN_SHARE));
  const most = Math.max(...views.map(({ gain }) => gain), 0);
  const [ends, colours, faces]: [number[], number[], Vector3[]] = [[], [], []];
  const add = (point: Vector3, share: number): void => {
    ends.push(...point.toArray());
    colours.push(...PLAN_COLOURS[0].clone().lerp(PLAN_COLOURS[1], share).toArray());
  };
  for (const { pose, gain } of views) {
    const matrix = matrixOf(pose);
    for (const corner of shape.outline) add(new Vector3().fromArray(shape.positions, corner * 3).applyMatrix4(matrix), gain / most);
    faces.push(new Vector3(0, 0, plane.pivot_depth_mm).applyMatrix4(matrix));
  }
  for (const [index, face] of faces.entries()) if (index > 0) for (const end of [faces[index - 1]!, face]) add(end, 0.5);
  const geometry = new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(ends), 3));
  geometry.setAttribute("color", new BufferAttribute(new Float32Array(colours), 3));
  const lines = new LineSegments(geometry, new LineBasicMaterial({ vertexColors: true, depthTest: false, transparent: true }));
  lines.renderOrder = TRACE.order; // tissue does not hide where to go
  return lines;
}

export function skinMesh(skin: Skin): Mesh<BufferGeometry, MeshLambertMaterial> {
  const { columns, rows } = skin;
  const positions = new Float32Array(3 * columns * rows);
  const indices: number[] = [];
  for (let row = 0; row < rows; row++)
    for (let column = 0; column < columns; column++) {
      const at = row * columns + column;
      positions.set(skin.corner(column, row), 3 * at);
      const square = [at, at + 1, at + columns, at + columns + 1] as const;
      if (column === columns - 1 || row === rows - 1 || square.some((corner) => !skin.near[corner])) continue;
      indices.push(square[0], square[1], square[2], square[2], square[1], square[3]);
    }
  const geometry = new BufferGeometry().setAttribute("position", new BufferAttribute(positions, 3));
  geometry.setIndex(indices);
  geometry.computeVertexNormals();
  const material = new MeshLambertMaterial({
    color: 0xd9a183,
    transparent: true,
    opacity: 0.22,
    side: DoubleSide,
    depthWrite: false,
  });
  return new Mesh(geometry, material);
}

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

/** The live image in its plane, at the pose that it was rendered at. */
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

const THICKNESS_MM = 9;
const BODY_MM = 13;
const HANDLE_MM = 26;
const LEAST_FACE_MM = 14;

/** In the probe frame; what it sends into is +z, or all around it: then it is a catheter along the elevation. */
export function probeBody({ lines_mm, pivot_depth_mm: face }: ImagePlane): Group {
  const { left, right } = boxOf(shortened(lines_mm, 0));
  const width = Math.max(LEAST_FACE_MM, right - left);
  const body = new Group();
  const shell = new MeshLambertMaterial({ color: 0xdfe5ea });
  const mark = new Mesh(new SphereGeometry(2.2, 16, 12), new MeshLambertMaterial({ color: 0x5bbde4 }));
  if (areAllAround(lines_mm)) {
    const radius = Math.max(0.2, (right - left) / 2);
    const catheter = new Mesh(new CylinderGeometry(radius, radius, HANDLE_MM, 20), shell);
    catheter.position.y = -HANDLE_MM / 2;
    mark.position.set(-radius, -HANDLE_MM / 2, 0);
    body.add(catheter);
  } else {
    const head = new Mesh(new BoxGeometry(width, THICKNESS_MM, BODY_MM), shell);
    head.position.z = face - BODY_MM / 2;
    const handle = new Mesh(new CylinderGeometry(4.5, 5.5, HANDLE_MM, 20), shell);
    handle.rotation.x = Math.PI / 2;
    handle.position.z = face - BODY_MM - HANDLE_MM / 2;
    mark.position.set(-width / 2, 0, face - BODY_MM / 2);
    body.add(head, handle);
  }
  const shape = planeShape(lines_mm);
  const outline = new BufferGeometry().setAttribute("position", new BufferAttribute(shape.positions, 3));
  outline.setIndex(shape.outline);
  return body.add(mark, new LineSegments(outline, new LineBasicMaterial({ color: 0xffc94d })));
}

const TOOL_COLOUR = 0xff8a5c;
const TRACE = { opacity: 0.4, order: 11 }; // after the tissue, which is laid over at 10
const THINNEST_MM = 0.5; // radius: what is thinner is not seen
const SIDES = 16;
const UP = new Vector3(0, 1, 0); // along which three.js makes cylinders

/** The tools of an image as things in space: solid, and as a pale trace through the tissue that hides them. */
export class ToolBodies {
  readonly object = new Group();
  /** Those that move with the probe. */
  readonly #held = new Group();

  constructor() {
    this.object.add(this.#held);
  }

  set(tools: readonly Tool[]): void {
    for (const body of this.object.children.filter((one) => one !== this.#held)) drop(body);
    for (const body of [...this.#held.children]) drop(body);
    for (const tool of tools) (tool.frame === "probe" ? this.#held : this.object).add(bodyOf(tool));
  }

  setPose(pose: Pose): void {
    placeObject(this.#held, pose);
  }

  dispose(): void {
    drop(this.object);
  }
}

function bodyOf(tool: Tool): Group {
  const geometry = isRod(tool) ? rodGeometry(lengthOf(tool), tool.diameter_mm) : new BoxGeometry(...tool.size_mm);
  const body = new Group().add(...partsOf(geometry));
  if (!isRod(tool)) {
    placeObject(body, poseOfBox(tool));
    return body;
  }
  placeRod(body, tool.tip_mm, tool.hub_mm);
  return body;
}

function placeRod(rod: Object3D, from_mm: Vector, to_mm: Vector): void {
  const [from, to] = [new Vector3(...from_mm), new Vector3(...to_mm)];
  rod.position.copy(from).add(to).divideScalar(2);
  rod.quaternion.setFromUnitVectors(UP, to.sub(from).normalize());
}

function rodGeometry(length_mm: number, diameter_mm: number): CylinderGeometry {
  const radius_mm = Math.max(THINNEST_MM, diameter_mm / 2);
  return new CylinderGeometry(radius_mm, radius_mm, length_mm, SIDES);
}

function partsOf(geometry: BufferGeometry): [Mesh, Mesh] {
  const solid = new Mesh(geometry, new MeshLambertMaterial({ color: TOOL_COLOUR }));
  solid.layers.enable(OCCLUDERS);
  const seenThrough = { transparent: true, opacity: TRACE.opacity, depthTest: false, depthWrite: false };
  const trace = new Mesh(geometry, new MeshBasicMaterial({ color: TOOL_COLOUR, ...seenThrough }));
  trace.renderOrder = TRACE.order;
  return [solid, trace];
}

const SOLID_COLOURS = { held: 0xffd60a, other: 0xb09a3c };

/** Shapes of edits, pale, and seen through what is before them; `held`: the one that is worked on. */
export function solidBodies(solids: readonly Solid[], held: Solid | null): Group {
  const bodies = new Group();
  const pale = { transparent: true, opacity: TRACE.opacity, depthTest: false, depthWrite: false };
  const [bright, dim] = [SOLID_COLOURS.held, SOLID_COLOURS.other].map((color) => new MeshLambertMaterial({ color, ...pale }));
  for (const solid of solids) {
    for (const part of partsOfSolid(solid)) {
      part.material = solid === held ? bright! : dim!;
      part.renderOrder = TRACE.order;
      bodies.add(part);
    }
  }
  return bodies;
}

function partsOfSolid(solid: Solid): Mesh[] {
  switch (solid.kind) {
    case "sphere":
      return [ball(solid.centre_mm, solid.radius_mm)];
    case "ellipsoid": {
      const body = ball(solid.centre_mm, 1);
      placeObject(body, poseOfEllipsoid(solid));
      body.scale.set(...solid.radii_mm);
      return [body];
    }
    case "box": {
      const [low, high] = [solid.min_mm, solid.max_mm];
      const body = new Mesh(new BoxGeometry(high[0] - low[0], high[1] - low[1], high[2] - low[2]));
      body.position.set(...middleOf(solid));
      return [body];
    }
    case "tube": {
      const { points_mm, radius_mm } = solid;
      const pieces = points_mm.slice(1).map((to, index) => {
        const from = points_mm[index]!;
        const piece = new Mesh(rodGeometry(length(minus(to, from)), 2 * radius_mm));
        placeRod(piece, from, to);
        return piece;
      });
      return [...pieces, ...points_mm.map((point) => ball(point, radius_mm))];
    }
  }
}

const UNIT_BALL = new SphereGeometry(1, 2 * SIDES, SIDES); // of all: a brush leaves hundreds

function ball(centre_mm: Vector, radius_mm: number): Mesh {
  const body = new Mesh(UNIT_BALL);
  body.position.set(...centre_mm);
  body.scale.setScalar(radius_mm);
  return body;
}
