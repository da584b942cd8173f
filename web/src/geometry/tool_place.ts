/** Where a tool is: its points in mm, in the frame of the scene or of the probe, and how it is moved. */

import type { ImagePlane, Tool, ToolFrame } from "../api/contract";
import { boxOf, type PlanePoint, pointOf } from "./plane";
import {
  apply, axis, fromPositionQuaternion, IDENTITY, inverse, length, minus, multiply, plus, type Pose, quaternion,
  type Quaternion, scaled, unit, type Vector,
} from "./pose";

/** A needle or a cylinder: a straight line from its tip to its hub. */
export type Rod = Extract<Tool, { tip_mm: unknown }>;
export type Box = Extract<Tool, { centre_mm: unknown }>;

/** Which way a rod points, in degrees of its frame: down along z from the plane of x and y, and there from x towards y. */
export interface Direction {
  steepness_deg: number;
  heading_deg: number;
}

const DEGREES = 180 / Math.PI;
const DIGITS = 3; // of a millimetre
const TURN_DIGITS = 6; // of a quaternion
/** Where a tool begins in the image, as shares of the way across and along the scan lines. */
const TIP = [0.62, 0.5] as const;
const HUB = [0.03, 0.1] as const;
const MIDDLE = [0.5, 0.5] as const;

export function isRod(tool: Tool): tool is Rod {
  return "tip_mm" in tool;
}

/** The point by which a tool is placed: the tip of a rod, the middle of a box. */
export function placeOfTool(tool: Tool): Vector {
  return isRod(tool) ? tool.tip_mm : tool.centre_mm;
}

/** The tool with that point elsewhere; it is not turned. */
export function placedTool<T extends Tool>(tool: T, place_mm: Vector): T {
  const way = minus(place_mm, placeOfTool(tool));
  const moved = (point: Vector): Vector => rounded(plus(point, way));
  if (isRod(tool)) return { ...tool, tip_mm: moved(tool.tip_mm), hub_mm: moved(tool.hub_mm) };
  return { ...tool, centre_mm: moved((tool as Box).centre_mm) };
}

/** The tool moved along its own axis: a rod towards its tip, a box along its own z. */
export function advanced<T extends Tool>(tool: T, by_mm: number): T {
  const along = isRod(tool) ? unit(minus(tool.tip_mm, tool.hub_mm)) : axis(poseOfBox(tool as Box), 2);
  return placedTool(tool, plus(placeOfTool(tool), scaled(along, by_mm)));
}

export function lengthOf({ tip_mm, hub_mm }: Rod): number {
  return length(minus(hub_mm, tip_mm));
}

/** The rod with another length, its tip where it was. */
export function lengthened<T extends Rod>(rod: T, length_mm: number): T {
  const back = unit(minus(rod.hub_mm, rod.tip_mm));
  return { ...rod, hub_mm: rounded(plus(rod.tip_mm, scaled(back, length_mm))) };
}

export function directionOf({ tip_mm, hub_mm }: Rod): Direction {
  const [x, y, z] = unit(minus(tip_mm, hub_mm));
  return { steepness_deg: Math.asin(z) * DEGREES, heading_deg: Math.atan2(y, x) * DEGREES };
}

/** The rod turned about its tip. */
export function directed<T extends Rod>(rod: T, { steepness_deg, heading_deg }: Direction): T {
  const [steepness, heading] = [steepness_deg / DEGREES, heading_deg / DEGREES];
  const towards: Vector = [
    Math.cos(steepness) * Math.cos(heading),
    Math.cos(steepness) * Math.sin(heading),
    Math.sin(steepness),
  ];
  return { ...rod, hub_mm: rounded(minus(rod.tip_mm, scaled(towards, lengthOf(rod)))) };
}

/** From a box's own frame to the frame that it is in. */
export function poseOfBox({ centre_mm, quaternion: turn }: Box): Pose {
  return fromPositionQuaternion(centre_mm, turn);
}

/** The box with another orientation, its middle where it was. */
export function turnedTo(box: Box, turn: Quaternion): Box {
  return { ...box, quaternion: turn.map((value) => Number(value.toFixed(TURN_DIGITS)) || 0) as [number, number, number, number] };
}

/** The tool told in another frame, where it is; `pose`: of the probe in the scene. */
export function toldIn<T extends Tool>(tool: T, frame: ToolFrame, pose: Pose): T {
  if (frame === tool.frame) return tool;
  const change = frame === "scene" ? pose : inverse(pose);
  const moved = (point: Vector): [number, number, number] => rounded(apply(change, point));
  if (isRod(tool)) return { ...tool, frame, tip_mm: moved(tool.tip_mm), hub_mm: moved(tool.hub_mm) };
  const box = tool as Box;
  return turnedTo({ ...box, frame, centre_mm: moved(box.centre_mm) }, multiply(quaternion(change), box.quaternion)) as Tool as T;
}

/** Puts a tool into the image: a rod from its left edge towards its middle, a box there. */
export function putInImage(tool: Tool, plane: ImagePlane, pose: Pose): Tool {
  const at = ([across, along]: readonly [number, number]): Vector => {
    const { x_mm, z_mm }: PlanePoint = pointOf(plane.lines_mm, across, along);
    return apply(tool.frame === "scene" ? pose : IDENTITY, [x_mm, 0, z_mm]);
  };
  if (isRod(tool)) return { ...tool, tip_mm: rounded(at(TIP)), hub_mm: rounded(at(HUB)) };
  const turn = tool.frame === "scene" ? quaternion(pose) : tool.quaternion;
  return turnedTo({ ...tool, centre_mm: rounded(at(MIDDLE)) }, turn);
}

/** Where the place of a tool lies for the probe: lateral, elevation (beside the image) and axial, mm. */
export function seenFrom(tool: Tool, pose: Pose): Vector {
  const place = placeOfTool(tool);
  return tool.frame === "probe" ? place : apply(inverse(pose), place);
}

/** How far along each axis a tool is moved by hand: all of the scene and something beyond, or of the image. */
export function rangesOf(
  frame: ToolFrame,
  bounds: { low: Vector; high: Vector },
  plane: ImagePlane,
  beyond_mm: number,
): { min: number; max: number }[] {
  const { left, right, top, bottom } = boxOf(plane.lines_mm);
  const half = (right - left) / 2;
  const [low, high]: [Vector, Vector] = frame === "scene" ? [bounds.low, bounds.high] : [[left, -half, top], [right, half, bottom]];
  return roomAround(low, high, beyond_mm);
}

/** The ranges of a box and of what is beyond it, in whole centimetres. */
export function roomAround(low: Vector, high: Vector, beyond_mm: number): { min: number; max: number }[] {
  return [0, 1, 2].map((i) => ({
    min: Math.floor((low[i]! - beyond_mm) / 10) * 10,
    max: Math.ceil((high[i]! + beyond_mm) / 10) * 10,
  }));
}

function rounded(point: Vector): [number, number, number] {
  return point.map((value) => Number(value.toFixed(DIGITS)) || 0) as [number, number, number];
}
