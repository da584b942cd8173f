/** Shapes that edits are about, in mm of the scene's frame: where they are, how they are moved, and their signed distance. */

import type { Shape } from "../api/edits";
import type { Box } from "./plane";
import {
  aboutAxis, apply, dot, fromPositionQuaternion, inverse, length, minus, plus, type Pose, scaled, unit, type Vector,
} from "./pose";

/** A shape whose surface its numbers tell; those of files and of labels the service alone knows. */
export type Solid = Exclude<Shape, { data: string } | { name: string }>;
export type Sphere = Extract<Solid, { kind: "sphere" }>;
export type Ellipsoid = Extract<Solid, { kind: "ellipsoid" }>;
type Triple = [number, number, number];

export function isSolid(shape: Shape): shape is Solid {
  return !("data" in shape || "name" in shape);
}

/** A shape of that kind about a point, so many mm from its middle to its side; a tube lies along `along`. */
export function shapeAt(kind: Shape["kind"], at: Vector, size_mm: number, along: Vector): Shape {
  const [centre_mm, size] = [rounded(at), [size_mm, size_mm, size_mm] as Triple];
  const half = scaled(along, 4 * size_mm);
  switch (kind) {
    case "sphere":
      return { kind, centre_mm, radius_mm: size_mm };
    case "ellipsoid":
      return { kind, centre_mm, radii_mm: size, turn_deg: [0, 0, 0] };
    case "box":
      return { kind, min_mm: rounded(minus(at, size)), max_mm: rounded(plus(at, size)) };
    case "tube":
      return { kind, points_mm: [rounded(minus(at, half)), rounded(plus(at, half))], radius_mm: size_mm / 2 };
    case "mesh":
      return { kind, data: "", format: "stl" };
    case "map":
      return { kind, data: "", format: "nii.gz", label: 0 };
    case "label":
      return { kind, name: "" };
  }
}

export function middleOf(solid: Solid): Vector {
  switch (solid.kind) {
    case "sphere":
    case "ellipsoid":
      return solid.centre_mm;
    case "box":
      return scaled(plus(solid.min_mm, solid.max_mm), 0.5);
    case "tube":
      return scaled(solid.points_mm.reduce<Vector>(plus, [0, 0, 0]), 1 / solid.points_mm.length);
  }
}

/** The solid with its middle elsewhere. */
export function movedTo(solid: Solid, middle: Vector): Solid {
  const way = minus(middle, middleOf(solid));
  const moved = (point: Vector): Triple => rounded(plus(point, way));
  switch (solid.kind) {
    case "sphere":
    case "ellipsoid":
      return { ...solid, centre_mm: moved(solid.centre_mm) };
    case "box":
      return { ...solid, min_mm: moved(solid.min_mm), max_mm: moved(solid.max_mm) };
    case "tube":
      return { ...solid, points_mm: solid.points_mm.map(moved) };
  }
}

/** From the axes of an ellipsoid to the scene. */
export function poseOfEllipsoid({ centre_mm, turn_deg }: Ellipsoid): Pose {
  return fromPositionQuaternion(centre_mm, aboutAxis(unit(turn_deg), length(turn_deg)));
}

/** How far a point lies from the surface, negative inside; of an ellipsoid to first order, as the service has it. */
export function distanceTo(solid: Solid): (point: Vector) => number {
  switch (solid.kind) {
    case "sphere": {
      const { centre_mm: [x, y, z], radius_mm } = solid;
      return ([a, b, c]) => Math.sqrt((a - x) ** 2 + (b - y) ** 2 + (c - z) ** 2) - radius_mm; // of hundreds, at thousands of points
    }
    case "ellipsoid": {
      const [into, [a, b, c]] = [inverse(poseOfEllipsoid(solid)), solid.radii_mm];
      const shrunk = ([x, y, z]: Vector): Vector => [x / a, y / b, z / c];
      return (point) => {
        const inside = shrunk(apply(into, point));
        const [radius, steepness] = [length(inside), length(shrunk(inside))];
        return steepness > 1e-9 ? ((radius - 1) * radius) / steepness : -Math.min(a, b, c);
      };
    }
    case "box": {
      const [middle, half] = [middleOf(solid), scaled(minus(solid.max_mm, solid.min_mm), 0.5)];
      return (point) => {
        const beyond = minus(point, middle).map((value, i) => Math.abs(value) - half[i]!);
        return Math.hypot(...beyond.map((value) => Math.max(value, 0))) + Math.min(Math.max(...beyond), 0);
      };
    }
    case "tube":
      return (point) => Math.min(...solid.points_mm.slice(1).map((to, i) => distanceToPiece(point, solid.points_mm[i]!, to))) - solid.radius_mm;
  }
}

/** How far a point lies from what shapes cover together, negative inside. */
export function distanceToAny(solids: readonly Solid[]): (point: Vector) => number {
  const distances = solids.map(distanceTo);
  return (point) => distances.reduce((least, distance) => Math.min(least, distance(point)), Infinity);
}

/** Spheres of a brush on its way to a point, half a radius from each other; without a last one, that at the point. */
export function spheresTo(to: Vector, radius_mm: number, last: Sphere | null): Sphere[] {
  const sphere = (at: Vector): Sphere => ({ kind: "sphere", centre_mm: rounded(at), radius_mm });
  if (last === null) return [sphere(to)];
  const [way, step] = [minus(to, last.centre_mm), radius_mm / 2];
  const count = Math.floor(length(way) / step);
  return Array.from({ length: count }, (_, index) => sphere(plus(last.centre_mm, scaled(way, ((index + 1) * step) / length(way)))));
}

function distanceToPiece(point: Vector, from: Vector, to: Vector): number {
  const [way, away] = [minus(to, from), minus(point, from)];
  const share = Math.max(0, Math.min(1, dot(away, way) / Math.max(dot(way, way), 1e-12)));
  return length(minus(away, scaled(way, share)));
}

/** The path, as SVG has it, along which a function is zero within a box: by marching squares, so many each way. */
export function zeroPath(value: (x: number, y: number) => number, { left, top, width, height }: Box, squares: number): string {
  const grid = Array.from({ length: (squares + 1) ** 2 }, (_, index) => {
    const [x, y] = [left + ((index % (squares + 1)) / squares) * width, top + (Math.floor(index / (squares + 1)) / squares) * height];
    return { x, y, value: value(x, y) };
  });
  let path = "";
  for (let row = 0; row < squares; row++)
    for (let column = 0; column < squares; column++) {
      const first = row * (squares + 1) + column;
      const corners = [first, first + 1, first + squares + 2, first + squares + 1].map((index) => grid[index]!);
      const crossings = corners.flatMap((a, side) => {
        const b = corners[(side + 1) % 4]!;
        if (a.value < 0 === b.value < 0) return [];
        const share = a.value / (a.value - b.value);
        return [`${(a.x + (b.x - a.x) * share).toFixed(1)} ${(a.y + (b.y - a.y) * share).toFixed(1)}`];
      });
      for (let i = 1; i < crossings.length; i += 2) path += `M${crossings[i - 1]}L${crossings[i]}`;
    }
  return path;
}

const DIGITS = 2; // of a millimetre

function rounded(point: Vector): Triple {
  return point.map((value) => Number(value.toFixed(DIGITS)) || 0) as Triple;
}
