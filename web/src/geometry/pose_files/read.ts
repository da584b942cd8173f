/** Files of poses by the ends of their names. */

import { fault } from "../pose_checks";
import { posesFromJson, timesFromJson } from "../pose_json";
import { posesFromCsv, posesFromTum } from "./lines";
import { posesFromNpy } from "./npy";
import { posesFromPlus } from "./plus";
import { PLAIN, type Chosen, type PoseFile } from "./pose_file";

/** As a file input takes them. */
export const POSE_SUFFIXES = [".json", ".npy", ".csv", ".tum", ".txt", ".mha", ".mhd"];
/** How much of a file is read: PLUS puts its images behind the poses. */
export const MOST_BYTES = 64 * 2 ** 20;

/** The poses of a file. Throws PoseError. */
export function readPoses(name: string, buffer: ArrayBuffer, chosen: Chosen = {}): PoseFile {
  const suffix = /\.[^.]*$/.exec(name.toLowerCase())?.[0] ?? "";
  const text = (): string => new TextDecoder("utf-8").decode(buffer);
  switch (suffix) {
    case ".json":
      return { ...PLAIN, poses: posesFromJson(text()), times_s: timesFromJson(text()), unit: "mm", unitIsKnown: true, takesUnit: false };
    case ".npy":
      return posesFromNpy(buffer, chosen);
    case ".csv":
      return posesFromCsv(text(), chosen);
    case ".tum":
    case ".txt":
      return posesFromTum(text(), chosen);
    case ".mha":
    case ".mhd":
      return posesFromPlus(new TextDecoder("latin1").decode(buffer), chosen);
    default:
      throw fault({ kind: "suffix", suffix });
  }
}
