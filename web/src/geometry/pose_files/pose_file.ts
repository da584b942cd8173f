/** A file of poses, as it was read. */

import { position, withPosition, type Pose } from "../pose";

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

export const PLAIN = { takesUnit: true, transforms: [], transform: null, skipped: 0 };

/** Poses whose lengths are in `unit`, in mm. */
export function inMillimetres(poses: Pose[], unit: Unit): Pose[] {
  if (unit === "mm") return poses;
  return poses.map((pose) => {
    const [x, y, z] = position(pose);
    return withPosition(pose, [x * 1000, y * 1000, z * 1000]);
  });
}
