/** The jobs of the service, as lists show them: the newest of a kind and state, asked for while somebody looks. */

import { explain } from "../api/client";
import { isFinal, listJobs, type Job } from "../api/jobs";
import { polled } from "../shared/polled";

const POLL_MS = 2000;
const PAGE = 30;

export class JobList {
  /** null: not asked for yet. */
  jobs = $state.raw<Job[] | null>(null);
  kind = $state("");
  state = $state("");
  more = $state(false);
  problem = $state<string | null>(null);
  /** Those under way, whatever is listed. */
  unfinished = $state.raw<Job[]>([]);
  #length = PAGE;
  #asked = 0;
  /** The newest request whose answer was taken: those to older ones come too late. */
  #taken = 0;

  /** Shows others: none are known until they come. */
  filter(kind: string, state: string): void {
    [this.kind, this.state, this.jobs, this.#length] = [kind, state, null, PAGE];
    void this.refresh();
  }

  async showMore(): Promise<void> {
    this.#length += PAGE;
    await this.refresh();
  }

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
      const listed = listJobs(this.#length, { kind: this.kind, state: this.state });
      const others = this.kind === "" && this.state === "" ? [] : [listJobs(PAGE, { kind: "", state: "" })];
      const [{ jobs, more }, newest] = await Promise.all([listed, ...others]);
      if (asked < this.#taken) return;
      this.unfinished = (newest?.jobs ?? jobs).filter((job) => !isFinal(job));
      this.#taken = asked;
      this.jobs = jobs.map((job) => this.#known(job));
      this.more = more;
      this.problem = null;
    } catch (error) {
      if (asked < this.#taken) return;
      this.#taken = asked;
      this.problem = explain(error);
      throw error;
    }
  }

  /** The object that stands for the job already, where nothing of it changed: its row is left alone. */
  #known(job: Job): Job {
    const before = this.jobs?.find((one) => one.id === job.id);
    return before !== undefined && JSON.stringify(before) === JSON.stringify(job) ? before : job;
  }
}

/** The list of all jobs, as Train shows it. */
export const jobList = new JobList();
