/** Poses as files of each format. */

import type { Pose } from "../pose";
import { poseJson } from "../pose_json";
import { csvOf, tumOf } from "./lines";
import { npyOf } from "./npy";

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
