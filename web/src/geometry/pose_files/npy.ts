/** NumPy's .npy: arrays [4, 4], [N, 4, 4], [N, 3, 4], [N, 12] or [N, 16] of float32 or float64. */

import { IDENTITY, type Pose } from "../pose";
import { fault, poseOfMatrix } from "../pose_checks";
import { requireCount } from "../pose_json";
import { inMillimetres, PLAIN, type Chosen, type PoseFile } from "./pose_file";

const MAGIC = [0x93, 0x4e, 0x55, 0x4d, 0x50, 0x59];

/** Throws PoseError. */
export function posesFromNpy(buffer: ArrayBuffer, { unit = "mm" }: Chosen): PoseFile {
  const { type, columnsFirst, shape, start } = headerOf(buffer);
  const item = /^([<>])f([48])$/.exec(type);
  if (item === null) throw fault({ kind: "npyType", type });
  const size = Number(item[2]);
  const each = sizeOfOne(shape);
  const total = shape.reduce((product, side) => product * side, 1);
  requireCount(total / each);
  if (buffer.byteLength < start + total * size) throw fault({ kind: "npy", problem: "short" });
  const view = new DataView(buffer, start);
  const little = item[1] === "<";
  const at = (index: number): number => (size === 8 ? view.getFloat64(index * 8, little) : view.getFloat32(index * 4, little));
  const place = columnsFirst ? (index: number) => at(fortran(index, shape)) : at;
  const poses = Array.from({ length: total / each }, (_, pose) =>
    poseOfMatrix(Array.from({ length: each }, (_, index) => place(pose * each + index)), { pose: pose + 1 }),
  );
  return { ...PLAIN, poses: inMillimetres(poses, unit), times_s: null, unit, unitIsKnown: false };
}

/** [N, 4, 4] of float64, mm. */
export function npyOf(poses: readonly Pose[]): Blob {
  const about = `{'descr': '<f8', 'fortran_order': False, 'shape': (${poses.length}, 4, 4), }`;
  const header = about.padEnd(Math.ceil((about.length + 11) / 64) * 64 - 11) + "\n"; // data begin at a multiple of 64
  const numbers = new Float64Array(poses.length * IDENTITY.length);
  poses.forEach((pose, index) => numbers.set(pose, index * IDENTITY.length));
  const length = new Uint8Array([header.length & 0xff, header.length >> 8]);
  return new Blob([new Uint8Array([...MAGIC, 1, 0]), length, header, numbers]);
}

function headerOf(buffer: ArrayBuffer): { type: string; columnsFirst: boolean; shape: number[]; start: number } {
  const bytes = new Uint8Array(buffer);
  if (MAGIC.some((byte, index) => bytes[index] !== byte) || bytes.length < 12) throw fault({ kind: "npy", problem: "magic" });
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
  throw fault({ kind: "npyShape", shape: `(${shape.join(", ")})` });
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
