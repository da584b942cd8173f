/** Poses that stand one on a line: CSV, and TUM's trajectories. */

import { position, quaternion, type Pose, type Quaternion, type Vector } from "../pose";
import { fault, numberOf, poseOfMatrix, poseOfQuaternion } from "../pose_checks";
import { requireCount } from "../pose_json";
import { inMillimetres, PLAIN, type Chosen, type PoseFile, type Unit } from "./pose_file";

interface Row {
  line: number;
  cells: string[];
}

const TIMES = ["time_s", "timestamp_s", "t_s", "time", "timestamp", "t"];
const QUATERNION = ["qw", "qx", "qy", "qz"];
const SEPARATOR = /[,;\t]\s*|\s+/;

/** timestamp tx ty tz qx qy qz qw, metres; lines that begin with # are left out. Throws PoseError. */
export function posesFromTum(text: string, { unit = "m" }: Chosen): PoseFile {
  const rows = rowsOf(text, /[\s,]+/);
  const times_s: number[] = [];
  const poses = rows.map(({ line, cells }) => {
    if (cells.length !== 8) throw fault({ kind: "count", found: cells.length, expected: "8" }, { line });
    const [time, x, y, z, qx, qy, qz, qw] = cells.map((cell) => numberOf(cell, { line })) as Eight;
    times_s.push(time);
    return poseOfQuaternion([x, y, z], [qw, qx, qy, qz], { line });
  });
  requireCount(poses.length);
  return { ...PLAIN, poses: inMillimetres(poses, unit), times_s, unit, unitIsKnown: true };
}

/**
 * With a header of x, y, z (or x_mm …, x_m …), qw, qx, qy, qz and perhaps time_s; without one, 12 or 16 numbers of a
 * matrix a line. Throws PoseError.
 */
export function posesFromCsv(text: string, chosen: Chosen): PoseFile {
  const [first, ...others] = rowsOf(text, SEPARATOR);
  if (first === undefined) throw fault({ kind: "empty" });
  const isHeader = first.cells.some((cell) => !Number.isFinite(Number(cell)));
  return isHeader ? withHeader(first, others, chosen) : matrices([first, ...others], chosen);
}

/** x_mm …, quaternion and time_s. */
export function csvOf(poses: readonly Pose[], times_s: readonly number[] | null): string {
  const header = [...(times_s ? ["time_s"] : []), "x_mm", "y_mm", "z_mm", ...QUATERNION].join(",");
  const lines = poses.map((pose, index) => {
    const time = times_s ? [times_s[index]!.toFixed(4)] : [];
    return [...time, ...position(pose).map((value) => value.toFixed(4)), ...quaternion(pose).map(digits)].join(",");
  });
  return [header, ...lines, ""].join("\n");
}

/** Metres; poses without times are numbered. */
export function tumOf(poses: readonly Pose[], times_s: readonly number[] | null): string {
  const lines = poses.map((pose, index) => {
    const [w, x, y, z] = quaternion(pose);
    const place = position(pose).map((value) => (value / 1000).toFixed(7));
    return [(times_s?.[index] ?? index).toFixed(4), ...place, ...[x, y, z, w].map(digits)].join(" ");
  });
  return ["# timestamp tx ty tz qx qy qz qw", ...lines, ""].join("\n");
}

type Eight = [number, number, number, number, number, number, number, number];

function digits(value: number): string {
  return value.toFixed(8);
}

function rowsOf(text: string, separator: RegExp): Row[] {
  return text
    .split(/\r?\n/)
    .map((line, index) => ({ line: index + 1, written: line.trim() }))
    .filter(({ written }) => written !== "" && !written.startsWith("#"))
    .map(({ line, written }) => ({ line, cells: written.split(separator).map((cell) => cell.replace(/^"|"$/g, "")) }));
}

function withHeader(header: Row, rows: Row[], chosen: Chosen): PoseFile {
  const names = header.cells.map((cell) => cell.toLowerCase());
  const suffix = ["_mm", "_m", ""].find((one) => names.includes(`x${one}`)) ?? "";
  const needed = [...["x", "y", "z"].map((axis) => axis + suffix), ...QUATERNION];
  const missing = needed.filter((name) => !names.includes(name));
  if (missing.length > 0) throw fault({ kind: "csvHeader", missing }, { line: header.line });
  const time = TIMES.map((name) => names.indexOf(name)).find((column) => column >= 0);
  const times_s: number[] = [];
  const poses = rows.map(({ line, cells }) => {
    if (cells.length !== names.length)
      throw fault({ kind: "count", found: cells.length, expected: String(names.length) }, { line });
    const values = needed.map((name) => numberOf(cells[names.indexOf(name)]!, { line }));
    if (time !== undefined) times_s.push(numberOf(cells[time]!, { line }));
    return poseOfQuaternion(values.slice(0, 3) as unknown as Vector, values.slice(3) as unknown as Quaternion, { line });
  });
  requireCount(poses.length);
  const known = { _mm: "mm", _m: "m" }[suffix] as Unit | undefined;
  const unit = chosen.unit ?? known ?? "mm";
  const times = time === undefined ? null : times_s;
  return { ...PLAIN, poses: inMillimetres(poses, unit), times_s: times, unit, unitIsKnown: known !== undefined };
}

function matrices(rows: Row[], { unit = "mm" }: Chosen): PoseFile {
  const poses = rows.map(({ line, cells }) => {
    if (cells.length !== 12 && cells.length !== 16)
      throw fault({ kind: "csvHeader", missing: ["x_mm", "y_mm", "z_mm", ...QUATERNION] }, { line });
    return poseOfMatrix(cells.map((cell) => numberOf(cell, { line })), { line });
  });
  requireCount(poses.length);
  return { ...PLAIN, poses: inMillimetres(poses, unit), times_s: null, unit, unitIsKnown: false };
}
