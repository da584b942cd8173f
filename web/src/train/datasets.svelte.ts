/** The sweeps of the service, as Train lists them, and which is looked at. */

import { explain } from "../api/client";
import { listDatasets, type Dataset } from "../api/datasets";
import { polled } from "../shared/polled";

const POLL_MS = 4000;

class Datasets {
  /** null: not asked for yet. */
  all = $state.raw<Dataset[] | null>(null);
  /** Name of the dataset that is looked at; empty: none. */
  chosen = $state("");
  problem = $state<string | null>(null);
  readonly dataset = $derived(this.all?.find((one) => one.name === this.chosen) ?? null);
  readonly names = $derived((this.all ?? []).map(({ name }) => name));
  #asked = 0;
  /** The newest request whose answer was taken: those to older ones come too late. */
  #taken = 0;

  async refresh(): Promise<void> {
    await this.#ask().catch(() => undefined); // it is told as the problem
  }

  /** Asks now and from now on; the answer ends it. */
  poll(): () => void {
    const nothing = (): void => undefined;
    return polled(() => this.#ask(), POLL_MS, nothing, nothing);
  }

  async #ask(): Promise<void> {
    const asked = ++this.#asked;
    try {
      const found = await listDatasets();
      if (asked < this.#taken) return;
      this.#taken = asked;
      this.all = found.map((dataset) => this.#known(dataset));
      if (this.dataset === null) this.chosen = this.all[0]?.name ?? "";
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
    const before = this.all?.find((one) => one.name === dataset.name);
    return before?.sha256 === dataset.sha256 && before.created_at === dataset.created_at ? before : dataset;
  }
}

export const datasets = new Datasets();
