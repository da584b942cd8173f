/** The transforms of PLUS's sequence files (.igs.mha, .mha, .mhd): text at their beginning, mm. */

import type { Pose } from "../pose";
import { fault, numberOf, poseOfMatrix } from "../pose_checks";
import { PoseError } from "../pose_faults";
import { requireCount } from "../pose_json";
import type { Chosen, PoseFile } from "./pose_file";

const ENTRY = /^Seq_Frame(\d+)_(\w+)$/;
const LIKELY = ["ProbeToReference", "ProbeToTracker", "ProbeToWorld"];

interface SequenceFrame {
  line: number;
  time_s: number | null;
  matrices: Map<string, { line: number; text: string }>;
  invalid: Set<string>;
}

/** Throws PoseError. */
export function posesFromPlus(text: string, chosen: Chosen): PoseFile {
  const frames = framesOf(text);
  const names = [...new Set(frames.flatMap((frame) => [...frame.matrices.keys()]))];
  if (names.length === 0) throw fault({ kind: "plusHeader" });
  const rigid = names.filter((name) => isRigid(frames, name));
  if (rigid.length === 0) throw fault({ kind: "plusTransforms", found: names });
  const likely = LIKELY.find((name) => rigid.includes(name)) ?? rigid.find((name) => name.startsWith("Probe"));
  const transform = chosen.transform ?? likely ?? rigid[0]!;
  const used = frames.filter((frame) => frame.matrices.has(transform) && !frame.invalid.has(transform));
  const poses: Pose[] = used.map((frame) => read(frame.matrices.get(transform)!));
  requireCount(poses.length);
  const times = used.map((frame) => frame.time_s);
  return {
    poses,
    times_s: times.includes(null) ? null : (times as number[]),
    unit: "mm",
    unitIsKnown: true,
    takesUnit: false,
    transforms: rigid,
    transform,
    skipped: frames.length - used.length,
  };
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
    if (error instanceof PoseError && error.fault.kind === "rotation") return false;
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
