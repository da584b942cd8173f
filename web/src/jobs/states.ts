/** The states of jobs as colours tell them. */

import type { JobState } from "../api/jobs";

const TONES: Record<JobState, string> = { queued: "", running: "warn", succeeded: "good", failed: "bad", cancelled: "" };

/** The class of a tag. */
export function toneOf(state: JobState): string {
  return TONES[state];
}
