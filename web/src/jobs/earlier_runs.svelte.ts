/** Curves of earlier trainings of a dataset, laid over that of a job: the person chooses which. */

import { SvelteMap } from "svelte/reactivity";

import { explain } from "../api/client";
import { listJobs, trainingCurve, type CurvePoint, type Job } from "../api/jobs";

const LISTED = 100;
export const MOST_SHOWN = 4; // as many colours are left

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
