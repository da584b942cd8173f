/** What can be run as a job, as the service describes it. */

import type { Described } from "./described";
import { jobs } from "./generated/work";

/** What a job of each kind is specified by. */
export const JOB_KINDS: ReadonlyMap<string, Described> = new Map(Object.entries(jobs));
