/** What other programs do with a scene: the streams that they have open, and the jobs that render a path for them. */

import { explain, untilAnswered } from "../api/client";
import { cancelJob, followJob, isFinal, type Job, startJob } from "../api/jobs";
import { listStreams, PAGE, PAGE_NAME, type StreamSummary } from "../api/stream";
import type { Pose } from "../geometry/pose";
import { service } from "../page/service.svelte";
import type { Session } from "../session/session.svelte";
import { base64, polled } from "../shared/asking.svelte";

const EVERY_MS = 1000;

/** The streams that other programs have open on a scene, looked for every second. */
export class OpenStreams {
  /** null: not known yet. */
  others = $state.raw<StreamSummary[] | null>(null);

  /** Must be made while a component is being made. `wanted`: whether anybody looks. */
  constructor(scene: () => string, wanted: () => boolean) {
    $effect(() => {
      if (service.status !== "ready" || !wanted()) return;
      const take = (all: StreamSummary[]): void => void (this.others = all.filter(({ name }) => name !== PAGE_NAME + PAGE));
      const of = scene();
      return polled((signal) => listStreams(of, signal), EVERY_MS, take, () => undefined);
    });
  }
}

/** A path that becomes a data set: a job of the service, from its start to its files. */
export class Rendering {
  job = $state.raw<Job | null>(null);
  problem = $state<string | null>(null);
  #sending = $state(false);
  readonly isUnderWay = $derived(this.#sending || (this.job !== null && !isFinal(this.job)));
  #stopped = new AbortController();

  /** Renders poses with the image settings of a session. */
  async start(session: Session, poses: readonly Pose[], format: string): Promise<void> {
    this.problem = null;
    this.#sending = true;
    const specification = { scene: session.name, poses: written(poses), format, ...session.settings(["bmode"]) };
    try {
      this.job = await startJob("render", specification, false);
      this.#sending = false;
      await this.#follow(this.job.id);
    } catch (error) {
      if (!this.#stopped.signal.aborted) this.problem = explain(error);
    } finally {
      this.#sending = false;
    }
  }

  async cancel(): Promise<void> {
    try {
      if (this.job !== null) await cancelJob(this.job.id);
    } catch (error) {
      this.problem = explain(error);
    }
  }

  /** Leaves the job to the service. */
  leave(): void {
    this.#stopped.abort();
  }

  async #follow(id: string): Promise<void> {
    let last: string | null = null;
    const told = {
      job: (job: Job) => (this.job = job),
      log: () => undefined,
      event: (event: string) => (last = event),
    };
    const { signal } = this.#stopped;
    while (this.isUnderWay && !signal.aborted)
      await untilAnswered(() => followJob(id, last, told, signal), () => undefined, signal);
  }
}

/** Row by row as float64, the low byte first. */
function written(poses: readonly Pose[]): string {
  return base64(new Uint8Array(new Float64Array(poses.flat()).buffer));
}
