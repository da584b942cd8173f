/** Jobs: trainings above all, followed while they run. */

import { getJson, request, segment, sendJson } from "./client";

export type JobState = "queued" | "running" | "succeeded" | "failed" | "cancelled";

export interface Job {
  id: string;
  kind: "train" | "render";
  state: JobState;
  specification: { dataset?: string; scene: string; preset?: string; settings?: Record<string, unknown> };
  created_at: string;
  started_at: string | null;
  finished_at: string | null;
  reason: string | null;
  error: string | null;
  progress: {
    step: number | null;
    steps: number | null;
    loss: number | null;
    val_psnr_db: number | null;
    gaussians: number | null;
    rate_per_s: number | null;
    seconds_left: number | null;
  };
  artifacts: string[];
  metrics: Record<string, number>;
  retry_of: string | null;
}

export interface CurvePoint {
  step: number;
  loss: number;
  val_psnr_db: number | null;
}

export interface Training {
  dataset: string;
  scene: string;
  preset: "fast" | "paper";
  settings: Record<string, unknown>;
}

const FINAL: readonly JobState[] = ["succeeded", "failed", "cancelled"];

export function isFinal(job: Job): boolean {
  return FINAL.includes(job.state);
}

/** The newest trainings. */
export async function listTrainings(count: number): Promise<Job[]> {
  return (await getJson<{ jobs: Job[] }>(`/v1/jobs?kind=train&page_size=${count}`)).jobs;
}

export function startTraining(training: Training): Promise<Job> {
  return sendJson("POST", "/v1/jobs", { kind: "train", specification: training });
}

export function cancelJob(id: string): Promise<Job> {
  return sendJson("POST", `/v1/jobs/${segment(id)}:cancel`);
}

export function retryJob(id: string): Promise<Job> {
  return sendJson("POST", `/v1/jobs/${segment(id)}:retry`);
}

/** The training so far, in a few hundred points. */
export async function trainingCurve(id: string, signal: AbortSignal): Promise<CurvePoint[]> {
  return (await getJson<{ points: CurvePoint[] }>(`/v1/jobs/${segment(id)}/curve`, signal)).points;
}

export function previewPath(id: string): string {
  return `/v1/jobs/${segment(id)}/preview`;
}

export function artifactPath(id: string, name: string): string {
  return `/v1/jobs/${segment(id)}/artifacts/${segment(name)}`;
}

/** Tells of the job until its final state. Ends early where the stream breaks; then it can be asked for again. */
export async function followJob(
  id: string,
  told: { job: (job: Job) => void; log: (lines: string) => void },
  signal: AbortSignal,
): Promise<void> {
  const response = await request(`/v1/jobs/${segment(id)}/events`, { signal });
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

function tell(event: string, told: { job: (job: Job) => void; log: (lines: string) => void }): void {
  const lines = event.split("\n");
  const data = lines.filter((line) => line.startsWith("data: ")).map((line) => line.slice(6)).join("\n");
  if (lines.includes("event: progress")) told.job(JSON.parse(data) as Job);
  if (lines.includes("event: log")) told.log(data + "\n");
}
