/** The streams that other programs have open on a scene, looked for every second. */

import { listStreams, PAGE_NAME, type StreamSummary } from "../api/streams";
import { PAGE } from "../api/stream";
import { pauseAfter } from "../api/client";
import { service } from "../shell/service.svelte";

const EVERY_MS = 1000;

export class OpenStreams {
  /** null: not known yet. */
  others = $state.raw<StreamSummary[] | null>(null);

  /** Must be made while a component is being made. `wanted`: whether anybody looks. */
  constructor(scene: () => string, wanted: () => boolean) {
    $effect(() => {
      if (service.status !== "ready" || !wanted()) return;
      const stopped = new AbortController();
      void this.#follow(scene(), stopped.signal);
      return () => stopped.abort();
    });
  }

  async #follow(scene: string, signal: AbortSignal): Promise<void> {
    while (!signal.aborted) {
      let pause_ms = EVERY_MS;
      try {
        const all = await listStreams(scene, signal);
        this.others = all.filter(({ name }) => name !== PAGE_NAME + PAGE);
      } catch (error) {
        pause_ms = pauseAfter(error, EVERY_MS);
      }
      await new Promise((resolve) => setTimeout(resolve, pause_ms));
    }
  }
}
