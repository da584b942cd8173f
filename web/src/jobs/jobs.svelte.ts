/** The jobs of the service as Train shows them: the list, one that is followed, and earlier runs beside it. */

import { SvelteMap } from "svelte/reactivity";

import { explain, pauseAfter, ServiceError, Unreachable } from "../api/client";
import { type CurvePoint, followJob, isFinal, type Job, type JobState, listJobs, trainingCurve } from "../api/jobs";
import { Listed } from "../shared/asking.svelte";

const TONES: Record<JobState, string> = { queued: "", running: "warn", succeeded: "good", failed: "bad", cancelled: "" };

/** The class of a tag. */
export function toneOf(state: JobState): string {
  return TONES[state];
}

const PAGE = 30;

/** The jobs of the service, as lists show them: the newest of a kind and state, asked for while somebody looks. */
export class JobList extends Listed<Awaited<ReturnType<typeof listJobs>>[]> {
  /** null: not asked for yet. */
  jobs = $state.raw<Job[] | null>(null);
  kind = $state("");
  state = $state("");
  more = $state(false);
  /** Those under way, whatever is listed. */
  unfinished = $state.raw<Job[]>([]);
  #length = PAGE;

  /** Shows others: none are known until they come. */
  filter(kind: string, state: string): void {
    [this.kind, this.state, this.jobs, this.#length] = [kind, state, null, PAGE];
    void this.refresh();
  }

  async showMore(): Promise<void> {
    this.#length += PAGE;
    await this.refresh();
  }

  protected ask(): Promise<Awaited<ReturnType<typeof listJobs>>[]> {
    const listed = listJobs(this.#length, { kind: this.kind, state: this.state });
    return Promise.all(this.kind === "" && this.state === "" ? [listed] : [listed, listJobs(PAGE)]);
  }

  protected take([listed, newest]: Awaited<ReturnType<typeof listJobs>>[]): void {
    this.unfinished = (newest ?? listed)!.jobs.filter((job) => !isFinal(job));
    this.jobs = listed!.jobs.map((job) => this.#known(job));
    this.more = listed!.more;
  }

  /** The object that stands for the job already, where nothing of it changed: its row is left alone. */
  #known(job: Job): Job {
    const before = this.jobs?.find((one) => one.id === job.id);
    return before !== undefined && JSON.stringify(before) === JSON.stringify(job) ? before : job;
  }
}

/** The list of all jobs, as Train shows it. */
export const jobList = new JobList();

const RETRY_MS = 1000;
const LOG_KEPT = 20_000; // characters
const POINTS_KEPT = 1500; // then the curve is asked for again, thinned
const TICK_MS = 1000;

/** One job, followed until its end: what it says, its curve, its log. */
export class FollowedJob {
  job = $state.raw<Job | null>(null);
  curve = $state.raw<CurvePoint[]>([]);
  /** What classical methods reach, dB by method. */
  baselines = $state.raw<Record<string, number>>({});
  log = $state("");
  /** Until the end of the job, counted on between what the service tells; null: not known. */
  secondsLeft = $state<number | null>(null);
  /** Why nothing is told at the moment. */
  problem = $state<string | null>(null);
  missing = $state(false);
  #last: string | null = null;
  #ending = new AbortController();
  #asking = false;
  #timer: ReturnType<typeof setInterval>;

  constructor(private readonly id: string) {
    this.#timer = setInterval(() => {
      if (this.secondsLeft !== null) this.secondsLeft = Math.max(0, this.secondsLeft - TICK_MS / 1000);
    }, TICK_MS);
    void this.#follow();
  }

  close(): void {
    clearInterval(this.#timer);
    this.#ending.abort();
  }

  async #follow(): Promise<void> {
    const { signal } = this.#ending;
    while (!signal.aborted) {
      let pause_ms = RETRY_MS;
      try {
        await this.#askCurve();
        await followJob(
          this.id,
          this.#last,
          {
            job: (job) => this.#take(job),
            log: (lines) => (this.log = (this.log + lines).slice(-LOG_KEPT)),
            event: (id) => (this.#last = id),
          },
          signal,
        );
        this.problem = null;
        if (this.job && isFinal(this.job)) {
          await this.#askCurve();
          return;
        }
      } catch (error) {
        if (signal.aborted) return;
        this.missing = error instanceof ServiceError && error.reason === "JOB_NOT_FOUND";
        this.problem = error instanceof TypeError ? new Unreachable().message : explain(error);
        if (this.missing) return;
        pause_ms = pauseAfter(error, RETRY_MS);
      }
      await new Promise((resolve) => setTimeout(resolve, pause_ms));
    }
  }

  async #askCurve(): Promise<void> {
    const { points, baselines } = await trainingCurve(this.id, this.#ending.signal);
    this.curve = points;
    this.baselines = baselines ?? {};
  }

  #take(job: Job): void {
    const begins = job.progress.phase === "training" && this.job?.progress.phase !== "training";
    this.job = job;
    this.problem = null;
    this.secondsLeft = isFinal(job) ? null : job.progress.seconds_left;
    if (begins) void this.#askAgain(); // the classical methods have been measured by now
    const { step, loss, val_psnr_db } = job.progress;
    const last = this.curve.at(-1);
    if (step === null || loss === null || (last && step <= last.step)) return;
    const known = this.curve.findLast((point) => point.val_psnr_db !== null)?.val_psnr_db;
    this.curve = [...this.curve, { step, loss, val_psnr_db: val_psnr_db === known ? null : val_psnr_db }];
    if (this.curve.length > POINTS_KEPT) void this.#askAgain();
  }

  async #askAgain(): Promise<void> {
    if (this.#asking) return;
    this.#asking = true;
    try {
      await this.#askCurve();
    } catch {
      // the curve stays as it is until a later step asks again
    } finally {
      this.#asking = false;
    }
  }
}

const LISTED = 100;
export const MOST_SHOWN = 4; // as many colours are left

/** Curves of earlier trainings of a dataset, laid over that of a job: the person chooses which. */
export class EarlierRuns {
  /** Newest first; null: not asked for yet. */
  runs = $state.raw<Job[] | null>(null);
  problem = $state<string | null>(null);
  /** By run; `place` is free for another once it is taken away. */
  readonly curves = new SvelteMap<string, { points: CurvePoint[]; place: number }>();
  #ending = new AbortController();

  constructor(
    private readonly id: string,
    private readonly dataset: string,
  ) {
    void this.#list();
  }

  close(): void {
    this.#ending.abort();
  }

  /** Lays a run over the curve, or takes it away. */
  async toggle(run: string): Promise<void> {
    if (this.curves.delete(run) || this.curves.size >= MOST_SHOWN) return;
    const taken = [...this.curves.values()].map(({ place }) => place);
    const place = Array.from({ length: MOST_SHOWN }, (_, index) => index).find((index) => !taken.includes(index))!;
    this.curves.set(run, { points: [], place });
    try {
      const { points } = await trainingCurve(run, this.#ending.signal);
      if (this.curves.has(run)) this.curves.set(run, { points, place });
    } catch (error) {
      this.curves.delete(run);
      if (!this.#ending.signal.aborted) this.problem = explain(error);
    }
  }

  async #list(): Promise<void> {
    try {
      const { jobs } = await listJobs(LISTED, { kind: "train" });
      this.runs = jobs.filter(
        ({ id, specification, started_at }) => id !== this.id && specification.dataset === this.dataset && started_at !== null,
      );
    } catch (error) {
      this.problem = explain(error);
    }
  }
}
