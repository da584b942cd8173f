/** Jobs: trainings above all, started and followed while they run. */

import { address, getJson, postJson, remove, request, type Schemas } from "./client";

/** The specifications of jobs have these beside what their kind needs. */
export type Job = Schemas["Job"] & {
  specification: {
    scene?: string;
    dataset?: string;
    preset?: string;
    settings?: Record<string, unknown>;
    pose_count?: number | null;
  };
};
export type JobState = Job["state"];
export type JobKind = Job["kind"];
export type Phase = NonNullable<Job["progress"]["phase"]>;
export type CurvePoint = Schemas["CurvePoint"];
export type TrainingCurve = Schemas["TrainingCurve"];
/** What a render job would make. */
export type JobEstimate = Schemas["JobEstimate"];

export const STATES: readonly JobState[] = ["queued", "running", "succeeded", "failed", "cancelled"];

const FINAL: readonly JobState[] = ["succeeded", "failed", "cancelled"];

export function isFinal(job: Job): boolean {
  return FINAL.includes(job.state);
}

/** The jobs to list; what is empty passes all. */
export interface JobFilter {
  kind?: string;
  state?: string;
}

/** The newest jobs, at most `count`, and whether there are more. */
export async function listJobs(count: number, { kind = "", state = "" }: JobFilter = {}): Promise<{ jobs: Job[]; more: boolean }> {
  const page = await getJson("/v1/jobs", {}, { query: { page_size: String(count), kind, state } });
  return { jobs: page.jobs as Job[], more: page.next_page_token !== "" };
}

export const getJob = (job: string): Promise<Job> => getJson("/v1/jobs/{job}", { job }) as Promise<Job>;

/** Others see neither a private job nor the scene that it makes. */
export function startJob(kind: string, specification: Record<string, unknown>, isPrivate: boolean): Promise<Job> {
  return postJson("/v1/jobs", {}, { kind, specification, private: isPrivate }) as Promise<Job>;
}

export const cancelJob = (job: string): Promise<unknown> => postJson("/v1/jobs/{job}:cancel", { job });

export const retryJob = (job: string): Promise<Job> => postJson("/v1/jobs/{job}:retry", { job }) as Promise<Job>;

/** Removes a job that has ended, and its files. */
export const deleteJob = (job: string): Promise<void> => remove("/v1/jobs/{job}", { job });

/** What a render job of this specification would make; nothing is started. */
export function estimateRendering(specification: Record<string, unknown>, signal: AbortSignal): Promise<JobEstimate> {
  return postJson("/v1/jobs:estimate", {}, { kind: "render", specification }, signal);
}

/** The training so far, in a few hundred points, and what classical methods reach on the same frames. */
export function trainingCurve(job: string, signal: AbortSignal): Promise<TrainingCurve> {
  return getJson("/v1/jobs/{job}/curve", { job }, { signal });
}

export const previewPath = (job: string): string => address("/v1/jobs/{job}/preview", { job });

export function artifactPath(job: string, name: string): string {
  return address("/v1/jobs/{job}/artifacts/{name}", { job, name });
}

/** A file that a browser shows instead of saving it. */
export const shownPath = (job: string, name: string): string => `${artifactPath(job, name)}?show=true`;

/** What a job is about: the scene that it makes or needs, else its dataset. */
export function subjectOf({ specification }: Job): string {
  return specification.scene ?? specification.dataset ?? "";
}

/** Who is told of a job; `event`: the id of the last event, from which a later stream can go on. */
export interface JobListener {
  job: (job: Job) => void;
  log: (lines: string) => void;
  event: (id: string) => void;
}

/** Tells of the job until its final state. Ends early where the stream breaks; then it can be asked for what follows `last`. */
export async function followJob(job: string, last: string | null, told: JobListener, signal: AbortSignal): Promise<void> {
  const headers: Record<string, string> = last === null ? {} : { "Last-Event-ID": last };
  const response = await request(address("/v1/jobs/{job}/events", { job }), { signal, headers });
  const reader = response.body!.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    const events = (text + value).split("\n\n");
    text = events.pop() ?? "";
    for (const event of events) tell(event, told);
  }
}

function tell(event: string, told: JobListener): void {
  const lines = event.split("\n");
  const data = lines.filter((line) => line.startsWith("data: ")).map((line) => line.slice(6)).join("\n");
  if (lines.includes("event: progress")) told.job(JSON.parse(data) as Job);
  if (lines.includes("event: log")) told.log(data + "\n");
  const id = lines.find((line) => line.startsWith("id: "));
  if (id !== undefined) told.event(id.slice(4));
}
