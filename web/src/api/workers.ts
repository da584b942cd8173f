/** The workers that do the jobs. */

import { getJson, postJson, type Schemas } from "./client";

export type Worker = Schemas["Worker"];
export type WorkerState = Worker["state"];
/** What an admin may want of a worker. */
export type Wish = "pause" | "drain" | "resume";

export async function listWorkers(signal: AbortSignal): Promise<Worker[]> {
  return (await getJson("/v1/workers", {}, { signal })).workers;
}

export function wish(worker: string, wanted: Wish): Promise<Worker> {
  return postJson(`/v1/workers/{worker}:${wanted}`, { worker });
}
