/** Datasets and jobs of the service, as the Train view lists them. */

import { explain } from "../api/client";
import { listDatasets, type Dataset } from "../api/datasets";
import { listJobs, type Job } from "../api/jobs";
import { polled } from "../shared/polled";

const POLL_MS = 4000;
const JOBS_LISTED = 20;

class TrainingState {
  datasets = $state.raw<Dataset[]>([]);
  jobs = $state.raw<Job[]>([]);
  /** Name of the dataset that is looked at; empty: none. */
  chosen = $state("");
  problem = $state<string | null>(null);
  readonly dataset = $derived(this.datasets.find((one) => one.name === this.chosen) ?? null);
  #asked = 0;
  /** The newest request whose answer was taken: those to older ones come too late. */
  #taken = 0;

  async refresh(): Promise<void> {
    await this.#ask().catch(() => undefined); // it is told as the problem
  }

  async #ask(): Promise<void> {
    const asked = ++this.#asked;
    try {
      const [datasets, jobs] = await Promise.all([listDatasets(), listJobs(JOBS_LISTED)]);
      if (asked < this.#taken) return;
      this.#taken = asked;
      this.datasets = datasets.map((dataset) => this.#known(dataset));
      this.jobs = jobs;
      if (this.dataset === null) this.chosen = this.datasets[0]?.name ?? "";
      this.problem = null;
    } catch (error) {
      if (asked < this.#taken) return;
      this.#taken = asked;
      this.problem = explain(error);
      throw error;
    }
  }

  /** The object that stands for the dataset already: what is shown of it is not built anew at each answer. */
  #known(dataset: Dataset): Dataset {
    const before = this.datasets.find((one) => one.name === dataset.name);
    return before?.sha256 === dataset.sha256 && before.created_at === dataset.created_at ? before : dataset;
  }

  /** Asks now and from now on; the answer ends it. */
  poll(): () => void {
    const nothing = (): void => undefined;
    return polled(() => this.#ask(), POLL_MS, nothing, nothing);
  }
}

export const training = new TrainingState();
