/** The service in the last minutes. */

import { getJson } from "./client";

export const STAGES = ["queue", "render", "encode"] as const;
export type StageTimes = Record<(typeof STAGES)[number], number>;

export interface Step {
  seconds_ago: number;
  frames: number;
  requests: number;
  errors: number;
  p50_ms: StageTimes | null;
  p99_ms: StageTimes | null;
}

export interface Statistics {
  step_s: number;
  steps: Step[];
  waiting_frames: number;
  busy_processes: number;
  processes: number;
  process_restarts: number;
  memory_bytes: number;
  loaded_scenes: number;
  jobs: Record<string, number>;
}

export function statistics(signal: AbortSignal): Promise<Statistics> {
  return getJson("/v1/statistics", signal);
}
