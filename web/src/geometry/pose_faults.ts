/** What can be wrong with poses that somebody wrote. The words of an area say it to the person. */

export type PoseFault =
  | { kind: "json"; problem: string }
  | { kind: "jsonNumbers"; key: string; names: string[] }
  | { kind: "empty" }
  | { kind: "tooMany"; count: number; most: number }
  | { kind: "suffix"; suffix: string }
  | { kind: "count"; found: number; expected: string }
  | { kind: "number"; text: string }
  | { kind: "quaternion"; length: number }
  | { kind: "rotation"; mirrors: boolean }
  | { kind: "lastRow" }
  | { kind: "ros"; missing: string }
  | { kind: "npy"; problem: "magic" | "short" }
  | { kind: "npyType"; type: string }
  | { kind: "npyShape"; shape: string }
  | { kind: "csvHeader"; missing: string[] }
  | { kind: "plusHeader" }
  | { kind: "plusTransforms"; found: string[] };

/** Poses that cannot be read: what is wrong, and in which line, or pose, counted from 1. */
export class PoseError extends Error {
  constructor(
    readonly fault: PoseFault,
    readonly line: number | null = null,
    readonly pose: number | null = null,
  ) {
    super(JSON.stringify(fault));
    this.name = "PoseError";
  }
}
