/** One pose as text, in the forms that people and programs write poses in; always probe→scene. */

import { anglesFrom, entry, fromPositionQuaternion, IDENTITY, orientationFrom, position, quaternion, type Pose } from "./pose";
import { fault, numberOf, poseOfMatrix, poseOfQuaternion } from "./pose_checks";
import { poseFromJson, poseJson } from "./pose_json";

export const POSE_FORMS = ["json", "matrix", "quaternion", "euler", "numpy", "ros"] as const;
export type PoseForm = (typeof POSE_FORMS)[number];

const PER_METRE = 1000;
const NUMBER = /[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?/g;

/** Millimetres, but metres for ROS, as its messages want. */
export function poseText(pose: Pose, form: PoseForm): string {
  const [x, y, z] = position(pose).map((value) => fixed(value, 3));
  const [w, i, j, k] = quaternion(pose).map((value) => fixed(value, 6));
  switch (form) {
    case "json":
      return poseJson(pose);
    case "matrix":
      return rows(pose).map((row) => row.join(" ")).join("\n");
    case "quaternion":
      return `${x} ${y} ${z}  ${w} ${i} ${j} ${k}`;
    case "euler":
      return `${x} ${y} ${z}  ${anglesFrom(IDENTITY, pose).map((angle) => fixed(angle, 3)).join(" ")}`;
    case "numpy":
      return `np.array([${rows(pose).map((row) => `[${row.join(", ")}]`).join(",\n          ")}])`;
    case "ros": {
      const metres = position(pose).map((value) => fixed(value / PER_METRE, 6));
      const place = `position: {x: ${metres[0]}, y: ${metres[1]}, z: ${metres[2]}}`;
      return `${place}\norientation: {x: ${i}, y: ${j}, z: ${k}, w: ${w}}`;
    }
  }
}

/** Reads what `poseText` writes, and what people make of it. Throws PoseError. */
export function poseFromText(text: string, form: PoseForm): Pose {
  if (form === "json") return poseFromJson(text);
  if (form === "ros") return poseFromRos(text);
  const numbers = (text.replace(/\b(np|numpy)\.|\bfloat(32|64)\b/g, "").match(NUMBER) ?? []).map((one) => numberOf(one));
  if (form === "matrix" || form === "numpy") return poseOfMatrix(numbers);
  const [x, y, z, ...turn] = numbers as [number, number, number, ...number[]];
  if (form === "euler") {
    if (numbers.length !== 6) throw fault({ kind: "count", found: numbers.length, expected: "6" });
    return fromPositionQuaternion([x, y, z], orientationFrom(IDENTITY, turn as unknown as [number, number, number]));
  }
  if (numbers.length !== 7) throw fault({ kind: "count", found: numbers.length, expected: "7" });
  return poseOfQuaternion([x, y, z], turn as unknown as [number, number, number, number]);
}

/** geometry_msgs/Pose as YAML, in either of its styles, metres. */
function poseFromRos(text: string): Pose {
  const part = (name: string): string => {
    const found = new RegExp(`${name}\\s*:([\\s\\S]*?)(?=\\b(?:position|orientation)\\s*:|$)`).exec(text)?.[1];
    if (found === undefined) throw fault({ kind: "ros", missing: name });
    return found;
  };
  const value = (name: string, axis: string): number => {
    const found = new RegExp(`\\b${axis}\\s*:\\s*(${NUMBER.source})`).exec(part(name))?.[1];
    if (found === undefined) throw fault({ kind: "ros", missing: `${name}.${axis}` });
    return numberOf(found);
  };
  const [x, y, z] = ["x", "y", "z"].map((axis) => value("position", axis) * PER_METRE) as [number, number, number];
  const [w, i, j, k] = ["w", "x", "y", "z"].map((axis) => value("orientation", axis)) as [number, number, number, number];
  return poseOfQuaternion([x, y, z], [w, i, j, k]);
}

function rows(pose: Pose): string[][] {
  return [0, 1, 2, 3].map((row) => [0, 1, 2, 3].map((column) => fixed(entry(pose, row, column), column === 3 ? 3 : 6)));
}

/** So many digits at most, and no minus before zero. */
function fixed(value: number, digits: number): string {
  return String(Number(value.toFixed(digits)) + 0);
}
