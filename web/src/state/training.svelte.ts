/** Datasets and trainings of the service, as the Train view lists them. */

import { explain } from "../api/client";
import { listDatasets, type Dataset } from "../api/datasets";
import { listTrainings, type Job } from "../api/jobs";

const POLL_MS = 4000;
const JOBS_LISTED = 20;

class TrainingState {
  datasets = $state.raw<Dataset[]>([]);
  jobs = $state.raw<Job[]>([]);
  /** Name of the dataset that is looked at; empty: none. */
  chosen = $state("");
  problem = $state<string | null>(null);
  readonly dataset = $derived(this.datasets.find((one) => one.name === this.chosen) ?? null);

  async refresh(): Promise<void> {
    try {
      [this.datasets, this.jobs] = await Promise.all([listDatasets(), listTrainings(JOBS_LISTED)]);
      if (this.dataset === null) this.chosen = this.datasets[0]?.name ?? "";
      this.problem = null;
    } catch (error) {
      this.problem = explain(error);
    }
  }

  /** Asks now and from now on; the answer ends it. */
  poll(): () => void {
    void this.refresh();
    const timer = setInterval(() => void this.refresh(), POLL_MS);
    return () => clearInterval(timer);
  }
}

export const training = new TrainingState();
