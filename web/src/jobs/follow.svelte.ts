/** One job, followed until its end: what it says, its curve, its log. */

import { explain, pauseAfter, ServiceError, Unreachable } from "../api/client";
import { followJob, isFinal, trainingCurve, type CurvePoint, type Job } from "../api/jobs";

const RETRY_MS = 1000;
const LOG_KEPT = 20_000; // characters
const POINTS_KEPT = 1500; // then the curve is asked for again, thinned
const TICK_MS = 1000;

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
