/** One job, followed until its end: what it says, its curve, its log. */

import { explain, pauseAfter, ServiceError, Unreachable } from "../api/client";
import { followJob, isFinal, trainingCurve, type CurvePoint, type Job } from "../api/jobs";

const RETRY_MS = 1000;
const LOG_KEPT = 20_000; // characters
const POINTS_KEPT = 1500; // then the curve is asked for again, thinned

export class FollowedJob {
  job = $state.raw<Job | null>(null);
  curve = $state.raw<CurvePoint[]>([]);
  log = $state("");
  /** Why nothing is told at the moment. */
  problem = $state<string | null>(null);
  missing = $state(false);
  #last: string | null = null;
  #ending = new AbortController();
  #thinning = false;

  constructor(private readonly id: string) {
    void this.#follow();
  }

  close(): void {
    this.#ending.abort();
  }

  async #follow(): Promise<void> {
    const { signal } = this.#ending;
    while (!signal.aborted) {
      let pause_ms = RETRY_MS;
      try {
        this.curve = await trainingCurve(this.id, signal);
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
          this.curve = await trainingCurve(this.id, signal);
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

  #take(job: Job): void {
    this.job = job;
    this.problem = null;
    const { step, loss, val_psnr_db } = job.progress;
    const last = this.curve.at(-1);
    if (step === null || loss === null || (last && step <= last.step)) return;
    const known = this.curve.findLast((point) => point.val_psnr_db !== null)?.val_psnr_db;
    this.curve = [...this.curve, { step, loss, val_psnr_db: val_psnr_db === known ? null : val_psnr_db }];
    if (this.curve.length > POINTS_KEPT && !this.#thinning) void this.#thin();
  }

  async #thin(): Promise<void> {
    this.#thinning = true;
    try {
      this.curve = await trainingCurve(this.id, this.#ending.signal);
    } catch {
      // the curve stays as long as it is until a later step asks again
    } finally {
      this.#thinning = false;
    }
  }
}
