/** Poses as people and programs write them: one as text, many as JSON, CSV, TUM, NumPy or PLUS. What is read is checked as the service checks it. */

import {
  anglesFrom, axis, cross, dot, entry, fromPositionQuaternion, IDENTITY, orientationFrom, type Pose, position, quaternion,
  type Quaternion, scaled, type Vector, withPosition,
} from "./pose";

/** What can be wrong with poses: by the name of its sentence in the catalogues, what that is given. */
interface Faults {
  json: [problem: string];
  jsonNumbers: [key: string, names: string];
  empty: [];
  tooMany: [count: number, most: number];
  suffix: [suffix: string];
  count: [found: number, expected: string];
  number: [text: string];
  quaternion: [length: number];
  rotation: [];
  mirror: [];
  lastRow: [];
  ros: [missing: string];
  npyMagic: [];
  npyShort: [];
  npyType: [type: string];
  npyShape: [shape: string];
  csvHeader: [missing: string];
  plusHeader: [];
  plusTransforms: [found: string];
}
type Fault = keyof Faults;

/** How a language says what is wrong, and where. */
export interface FaultWords {
  line: (line: number, fault: string) => string;
  pose: (pose: number, fault: string) => string;
  faults: { [Kind in Fault]: (...given: Faults[Kind]) => string };
}

/** Where numbers stand: in which line, or pose, counted from 1. */
interface Where {
  line?: number;
  pose?: number;
}

/** Poses that cannot be read. */
export class PoseError<Kind extends Fault = Fault> extends Error {
  constructor(
    readonly kind: Kind,
    private readonly given: Faults[Kind],
    private readonly where: Where = {},
  ) {
    super(JSON.stringify([kind, ...given]));
    this.name = "PoseError";
  }

  /** In the words of a language. */
  said({ line, pose, faults }: FaultWords): string {
    const fault = faults[this.kind](...this.given);
    if (this.where.line !== undefined) return line(this.where.line, fault);
    return this.where.pose === undefined ? fault : pose(this.where.pose, fault);
  }
}

const ROTATION_TOLERANCE = 1e-3; // as of the service
const LENGTH_TOLERANCE = 1e-2;

/** The pose of 12 or 16 numbers, row by row. */
function poseOfMatrix(numbers: readonly number[], where: Where = {}): Pose {
  const pose = numbers.length === 12 ? [...numbers, 0, 0, 0, 1] : numbers;
  if (pose.length !== 16) throw new PoseError("count", [numbers.length, "12, 16"], where);
  const last = [0, 0, 0, 1].some((expected, column) => Math.abs(entry(pose, 3, column) - expected) > ROTATION_TOLERANCE);
  if (last) throw new PoseError("lastRow", [], where);
  const [x, y, z] = [axis(pose, 0), axis(pose, 1), axis(pose, 2)];
  const products = [dot(x, x) - 1, dot(y, y) - 1, dot(z, z) - 1, dot(x, y), dot(y, z), dot(z, x)]; // of RᵀR − 1
  if (!products.every((one) => Math.abs(one) <= ROTATION_TOLERANCE)) throw new PoseError("rotation", [], where);
  if (dot(cross(x, y), z) < 0) throw new PoseError("mirror", [], where);
  return fromPositionQuaternion(position(pose), quaternion(pose));
}

/** The pose of a place and a quaternion w, x, y, z. */
function poseOfQuaternion(place: Vector, rotation: Quaternion, where: Where = {}): Pose {
  const length = Math.hypot(...rotation);
  if (Math.abs(length - 1) > LENGTH_TOLERANCE) throw new PoseError("quaternion", [length], where);
  return fromPositionQuaternion(place, rotation);
}

/** A number as it is written. */
function numberOf(text: string, where: Where = {}): number {
  const number = Number(text);
  if (text.trim() === "" || !Number.isFinite(number)) throw new PoseError("number", [text.slice(0, 40)], where);
  return number;
}

const MOST_POSES = 100_000;

/** The pose as the JSON object that the service reads. */
export function poseJson(pose: Pose): string {
  const round = (value: number, digits: number): number => Number(value.toFixed(digits));
  const [x, y, z] = position(pose).map((value) => round(value, 3));
  const [w, i, j, k] = quaternion(pose).map((value) => round(value, 6));
  return JSON.stringify({ position_mm: { x, y, z }, quaternion: { w, x: i, y: j, z: k } });
}

/** One or more poses: such objects or matrices of three or four rows, in a list or under `poses`. Throws PoseError. */
function posesFromJson(text: string): Pose[] {
  const document = parsed(text);
  const given = isObject(document) && "poses" in document ? document.poses : document;
  const list = Array.isArray(given) && !isMatrix(given) ? (given as unknown[]) : [given];
  return list.map((one, index) => poseOf(one, list.length > 1 ? { pose: index + 1 } : {}));
}

/** Seconds of each pose under `times_s`; null where there are none. */
function timesFromJson(text: string): number[] | null {
  const document = parsed(text);
  const times = isObject(document) ? document.times_s : null;
  return Array.isArray(times) && times.every(Number.isFinite) ? (times as number[]) : null;
}

function parsed(text: string): unknown {
  try {
    return JSON.parse(text);
  } catch (error) {
    throw new PoseError("json", [error instanceof Error ? error.message : ""]);
  }
}

function poseOf(given: unknown, where: Where = {}): Pose {
  if (Array.isArray(given)) return poseOfMatrix(numbersIn(given), where);
  if (!isObject(given)) throw new PoseError("json", ["position_mm, quaternion"], where);
  if (given.matrix !== undefined) return poseOfMatrix(numbersIn(given.matrix), where);
  const place = numbersOf(given, "position_mm", ["x", "y", "z"], where);
  const [w, x, y, z] = numbersOf(given, "quaternion", ["w", "x", "y", "z"], where) as [number, number, number, number];
  return poseOfQuaternion(place as unknown as Vector, [w, x, y, z], where);
}

function numbersIn(given: unknown): number[] {
  const numbers = Array.isArray(given) ? (given.flat() as unknown[]) : [];
  return numbers.every(Number.isFinite) ? (numbers as number[]) : [];
}

/** Whether a list is one matrix, and not a list of poses. */
function isMatrix(list: unknown[]): boolean {
  const rows = list.every((row) => Array.isArray(row) && row.length === 4 && row.every(Number.isFinite));
  return rows && (list.length === 3 || list.length === 4);
}

function isObject(value: unknown): value is Record<string, unknown> {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function numbersOf(given: Record<string, unknown>, key: string, names: string[], where: Where): number[] {
  const value = given[key];
  const numbers = names.map((name) => (isObject(value) ? value[name] : undefined));
  if (!numbers.every((number) => typeof number === "number" && Number.isFinite(number)))
    throw new PoseError("jsonNumbers", [key, names.join(", ")], where);
  return numbers as number[];
}

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
  if (form === "json") return poseOf(parsed(text));
  if (form === "ros") return poseFromRos(text);
  const numbers = (text.replace(/\b(np|numpy)\.|\bfloat(32|64)\b/g, "").match(NUMBER) ?? []).map((one) => numberOf(one));
  if (form === "matrix" || form === "numpy") return poseOfMatrix(numbers);
  const expected = form === "euler" ? 6 : 7;
  if (numbers.length !== expected) throw new PoseError("count", [numbers.length, String(expected)]);
  const [x, y, z, ...turn] = numbers as [...Vector, ...number[]];
  if (form === "euler") return fromPositionQuaternion([x, y, z], orientationFrom(IDENTITY, turn as unknown as Vector));
  return poseOfQuaternion([x, y, z], turn as unknown as Quaternion);
}

/** geometry_msgs/Pose as YAML, in either of its styles, metres. */
function poseFromRos(text: string): Pose {
  const part = (name: string): string => {
    const found = new RegExp(`${name}\\s*:([\\s\\S]*?)(?=\\b(?:position|orientation)\\s*:|$)`).exec(text)?.[1];
    if (found === undefined) throw new PoseError("ros", [name]);
    return found;
  };
  const value = (name: string, axis: string): number => {
    const found = new RegExp(`\\b${axis}\\s*:\\s*(${NUMBER.source})`).exec(part(name))?.[1];
    if (found === undefined) throw new PoseError("ros", [`${name}.${axis}`]);
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

export type Unit = "mm" | "m";

export interface PoseFile {
  /** Translation in mm. */
  poses: Pose[];
  /** Seconds of each; null: the file has none. */
  times_s: number[] | null;
  /** Of lengths in the file. */
  unit: Unit;
  /** Whether the format, or the file, says so; else it is a guess. */
  unitIsKnown: boolean;
  /** Whether another unit can be chosen: the format does not fix it. */
  takesUnit: boolean;
  /** The transforms that a file with several of them holds, and the one that was read. */
  transforms: string[];
  transform: string | null;
  /** Frames without a valid pose. */
  skipped: number;
}

/** What a person chose where a file leaves it open. */
export interface Chosen {
  unit?: Unit;
  transform?: string;
}

/** Poses whose lengths are in `unit`, brought to mm. Throws PoseError for too few or too many. */
function fileOf(poses: Pose[], times_s: number[] | null, unit: Unit, unitIsKnown: boolean): PoseFile {
  requireCount(poses.length);
  const inMm = unit === "mm" ? poses : poses.map((pose) => withPosition(pose, scaled(position(pose), PER_METRE)));
  return { poses: inMm, times_s, unit, unitIsKnown, takesUnit: true, transforms: [], transform: null, skipped: 0 };
}

function requireCount(count: number): void {
  if (count === 0) throw new PoseError("empty", []);
  if (count > MOST_POSES) throw new PoseError("tooMany", [count, MOST_POSES]);
}

interface Row {
  line: number;
  cells: string[];
}

const TIMES = ["time_s", "timestamp_s", "t_s", "time", "timestamp", "t"];
const QUATERNION = ["qw", "qx", "qy", "qz"];
const SEPARATOR = /[,;\t]\s*|\s+/;

/** timestamp tx ty tz qx qy qz qw, metres; lines that begin with # are left out. Throws PoseError. */
function posesFromTum(text: string, { unit = "m" }: Chosen): PoseFile {
  const rows = rowsOf(text, /[\s,]+/);
  const times_s: number[] = [];
  const poses = rows.map(({ line, cells }) => {
    if (cells.length !== 8) throw new PoseError("count", [cells.length, "8"], { line });
    const [time, x, y, z, ...turn] = cells.map((cell) => numberOf(cell, { line })) as [number, ...Vector, ...Quaternion];
    times_s.push(time);
    return poseOfQuaternion([x, y, z], [turn[3], turn[0], turn[1], turn[2]], { line });
  });
  return fileOf(poses, times_s, unit, true);
}

/**
 * With a header of x, y, z (or x_mm …, x_m …), qw, qx, qy, qz and perhaps time_s; without one, 12 or 16 numbers of a
 * matrix a line. Throws PoseError.
 */
function posesFromCsv(text: string, chosen: Chosen): PoseFile {
  const [first, ...others] = rowsOf(text, SEPARATOR);
  if (first === undefined) throw new PoseError("empty", []);
  const isHeader = first.cells.some((cell) => !Number.isFinite(Number(cell)));
  return isHeader ? withHeader(first, others, chosen) : matrices([first, ...others], chosen);
}

/** x_mm …, quaternion and time_s. */
function csvOf(poses: readonly Pose[], times_s: readonly number[] | null): string {
  const header = [...(times_s ? ["time_s"] : []), "x_mm", "y_mm", "z_mm", ...QUATERNION].join(",");
  const lines = poses.map((pose, index) => {
    const time = times_s ? [times_s[index]!.toFixed(4)] : [];
    return [...time, ...position(pose).map((value) => value.toFixed(4)), ...quaternion(pose).map(digits)].join(",");
  });
  return [header, ...lines, ""].join("\n");
}

/** Metres; poses without times are numbered. */
function tumOf(poses: readonly Pose[], times_s: readonly number[] | null): string {
  const lines = poses.map((pose, index) => {
    const [w, x, y, z] = quaternion(pose);
    const place = position(pose).map((value) => (value / PER_METRE).toFixed(7));
    return [(times_s?.[index] ?? index).toFixed(4), ...place, ...[x, y, z, w].map(digits)].join(" ");
  });
  return ["# timestamp tx ty tz qx qy qz qw", ...lines, ""].join("\n");
}

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
  if (missing.length > 0) throw new PoseError("csvHeader", [missing.join(", ")], { line: header.line });
  const time = TIMES.map((name) => names.indexOf(name)).find((column) => column >= 0);
  const times_s: number[] = [];
  const poses = rows.map(({ line, cells }) => {
    if (cells.length !== names.length)
      throw new PoseError("count", [cells.length, String(names.length)], { line });
    const values = needed.map((name) => numberOf(cells[names.indexOf(name)]!, { line }));
    if (time !== undefined) times_s.push(numberOf(cells[time]!, { line }));
    return poseOfQuaternion(values.slice(0, 3) as unknown as Vector, values.slice(3) as unknown as Quaternion, { line });
  });
  const known = { _mm: "mm", _m: "m" }[suffix] as Unit | undefined;
  return fileOf(poses, time === undefined ? null : times_s, chosen.unit ?? known ?? "mm", known !== undefined);
}

function matrices(rows: Row[], { unit = "mm" }: Chosen): PoseFile {
  const poses = rows.map(({ line, cells }) => {
    if (cells.length !== 12 && cells.length !== 16)
      throw new PoseError("csvHeader", [["x_mm", "y_mm", "z_mm", ...QUATERNION].join(", ")], { line });
    return poseOfMatrix(cells.map((cell) => numberOf(cell, { line })), { line });
  });
  return fileOf(poses, null, unit, false);
}

const MAGIC = [0x93, 0x4e, 0x55, 0x4d, 0x50, 0x59];

/** Throws PoseError. */
function posesFromNpy(buffer: ArrayBuffer, { unit = "mm" }: Chosen): PoseFile {
  const { type, columnsFirst, shape, start } = headerOf(buffer);
  const item = /^([<>])f([48])$/.exec(type);
  if (item === null) throw new PoseError("npyType", [type]);
  const size = Number(item[2]);
  const each = sizeOfOne(shape);
  const total = shape.reduce((product, side) => product * side, 1);
  requireCount(total / each);
  if (buffer.byteLength < start + total * size) throw new PoseError("npyShort", []);
  const view = new DataView(buffer, start);
  const little = item[1] === "<";
  const at = (index: number): number => (size === 8 ? view.getFloat64(index * 8, little) : view.getFloat32(index * 4, little));
  const place = columnsFirst ? (index: number) => at(fortran(index, shape)) : at;
  const poses = Array.from({ length: total / each }, (_, pose) =>
    poseOfMatrix(Array.from({ length: each }, (_, index) => place(pose * each + index)), { pose: pose + 1 }),
  );
  return fileOf(poses, null, unit, false);
}

/** [N, 4, 4] of float64, mm. */
function npyOf(poses: readonly Pose[]): Blob {
  const about = `{'descr': '<f8', 'fortran_order': False, 'shape': (${poses.length}, 4, 4), }`;
  const header = about.padEnd(Math.ceil((about.length + 11) / 64) * 64 - 11) + "\n"; // data begin at a multiple of 64
  const numbers = new Float64Array(poses.length * IDENTITY.length);
  poses.forEach((pose, index) => numbers.set(pose, index * IDENTITY.length));
  const length = new Uint8Array([header.length & 0xff, header.length >> 8]);
  return new Blob([new Uint8Array([...MAGIC, 1, 0]), length, header, numbers]);
}

function headerOf(buffer: ArrayBuffer): { type: string; columnsFirst: boolean; shape: number[]; start: number } {
  const bytes = new Uint8Array(buffer);
  if (MAGIC.some((byte, index) => bytes[index] !== byte) || bytes.length < 12) throw new PoseError("npyMagic", []);
  const view = new DataView(buffer);
  const isOld = bytes[6] === 1;
  const start = (isOld ? 10 : 12) + (isOld ? view.getUint16(8, true) : view.getUint32(8, true));
  const about = new TextDecoder("latin1").decode(bytes.subarray(isOld ? 10 : 12, start));
  const type = /'descr':\s*'([^']*)'/.exec(about)?.[1] ?? "";
  const shape = /'shape':\s*\(([^)]*)\)/.exec(about)?.[1] ?? "";
  const sides = shape.split(",").filter((side) => side.trim() !== "");
  return { type, columnsFirst: /'fortran_order':\s*True/.test(about), shape: sides.map(Number), start };
}

/** How many numbers a pose has. */
function sizeOfOne(shape: number[]): number {
  const [rows, columns] = shape.slice(-2);
  if (columns === 4 && (rows === 4 || rows === 3) && shape.length <= 3) return 4 * rows;
  if (shape.length === 2 && (columns === 12 || columns === 16)) return columns;
  throw new PoseError("npyShape", [`(${shape.join(", ")})`]);
}

/** Where an element lies whose first index runs fastest. */
function fortran(index: number, shape: number[]): number {
  let place = 0;
  let rest = index;
  for (let axis = shape.length - 1; axis >= 0; axis--) {
    const stride = shape.slice(0, axis).reduce((product, side) => product * side, 1);
    place += (rest % shape[axis]!) * stride;
    rest = Math.floor(rest / shape[axis]!);
  }
  return place;
}

const ENTRY = /^Seq_Frame(\d+)_(\w+)$/;
const LIKELY = ["ProbeToReference", "ProbeToTracker", "ProbeToWorld"];

interface SequenceFrame {
  line: number;
  time_s: number | null;
  matrices: Map<string, { line: number; text: string }>;
  invalid: Set<string>;
}

/** Throws PoseError. */
function posesFromPlus(text: string, chosen: Chosen): PoseFile {
  const frames = framesOf(text);
  const names = [...new Set(frames.flatMap((frame) => [...frame.matrices.keys()]))];
  if (names.length === 0) throw new PoseError("plusHeader", []);
  const rigid = names.filter((name) => isRigid(frames, name));
  if (rigid.length === 0) throw new PoseError("plusTransforms", [names.join(", ")]);
  const likely = LIKELY.find((name) => rigid.includes(name)) ?? rigid.find((name) => name.startsWith("Probe"));
  const transform = chosen.transform ?? likely ?? rigid[0]!;
  const used = frames.filter((frame) => frame.matrices.has(transform) && !frame.invalid.has(transform));
  const poses = used.map((frame) => read(frame.matrices.get(transform)!));
  const times = used.map((frame) => frame.time_s);
  const file = fileOf(poses, times.includes(null) ? null : (times as number[]), "mm", true);
  return { ...file, takesUnit: false, transforms: rigid, transform, skipped: frames.length - used.length };
}

function read({ line, text }: { line: number; text: string }): Pose {
  return poseOfMatrix(text.trim().split(/\s+/).map((cell) => numberOf(cell, { line })), { line });
}

/** Whether the first valid matrix of a name can be a pose; those of images hold the size of pixels, too. */
function isRigid(frames: SequenceFrame[], name: string): boolean {
  const first = frames.find((frame) => frame.matrices.has(name) && !frame.invalid.has(name));
  if (first === undefined) return false;
  try {
    read(first.matrices.get(name)!);
    return true;
  } catch (error) {
    if (error instanceof PoseError && (error.kind === "rotation" || error.kind === "mirror")) return false;
    throw error;
  }
}

function framesOf(text: string): SequenceFrame[] {
  const frames = new Map<number, SequenceFrame>();
  for (const [index, written] of text.split(/\r?\n/).entries()) {
    const [key = "", ...rest] = written.split("=");
    if (key.trim() === "ElementDataFile") break; // pixels follow
    const found = ENTRY.exec(key.trim());
    if (found === null) continue;
    const number = Number(found[1]);
    const frame = frames.get(number) ?? { line: index + 1, time_s: null, matrices: new Map(), invalid: new Set() };
    frames.set(number, frame);
    note(frame, found[2]!, rest.join("=").trim(), index + 1);
  }
  return [...frames].sort(([a], [b]) => a - b).map(([, frame]) => frame);
}

function note(frame: SequenceFrame, field: string, value: string, line: number): void {
  if (field === "Timestamp") frame.time_s = numberOf(value, { line });
  else if (field.endsWith("TransformStatus")) {
    if (value !== "OK") frame.invalid.add(field.slice(0, -"TransformStatus".length));
  } else if (field.endsWith("Transform")) frame.matrices.set(field.slice(0, -"Transform".length), { line, text: value });
}

const utf8 = (buffer: ArrayBuffer): string => new TextDecoder("utf-8").decode(buffer);
const latin1 = (buffer: ArrayBuffer): string => new TextDecoder("latin1").decode(buffer);
const tum = (buffer: ArrayBuffer, chosen: Chosen): PoseFile => posesFromTum(utf8(buffer), chosen);
const plus = (buffer: ArrayBuffer, chosen: Chosen): PoseFile => posesFromPlus(latin1(buffer), chosen);
const READERS: Record<string, (buffer: ArrayBuffer, chosen: Chosen) => PoseFile> = {
  ".json": (buffer) => ({ ...fileOf(posesFromJson(utf8(buffer)), timesFromJson(utf8(buffer)), "mm", true), takesUnit: false }),
  ".npy": posesFromNpy,
  ".csv": (buffer, chosen) => posesFromCsv(utf8(buffer), chosen),
  ".tum": tum,
  ".txt": tum,
  ".mha": plus,
  ".mhd": plus,
};
/** As a file input takes them. */
export const POSE_SUFFIXES = Object.keys(READERS);
/** How much of a file is read: PLUS puts its images behind the poses. */
export const MOST_BYTES = 64 * 2 ** 20;

/** The poses of a file. Throws PoseError. */
export function readPoses(name: string, buffer: ArrayBuffer, chosen: Chosen = {}): PoseFile {
  const suffix = /\.[^.]*$/.exec(name.toLowerCase())?.[0] ?? "";
  const read = READERS[suffix];
  if (read === undefined) throw new PoseError("suffix", [suffix]);
  return read(buffer, chosen);
}

export const WRITTEN = ["json", "csv", "tum", "npy"] as const;
export type WrittenAs = (typeof WRITTEN)[number];

/** `times_s`: of each pose; NumPy's array has no place for them. */
export function poseFileOf(poses: readonly Pose[], times_s: readonly number[] | null, as: WrittenAs): Blob {
  switch (as) {
    case "json": {
      const times = times_s === null ? "" : `"times_s": ${JSON.stringify(times_s.map((time) => Number(time.toFixed(4))))},\n`;
      return new Blob([`{${times}"poses": [\n${poses.map(poseJson).join(",\n")}\n]}\n`], { type: "application/json" });
    }
    case "csv":
      return new Blob([csvOf(poses, times_s)], { type: "text/csv" });
    case "tum":
      return new Blob([tumOf(poses, times_s)], { type: "text/plain" });
    case "npy":
      return npyOf(poses);
  }
}
