/** Other scenes of the same sweep: which there are, and the comparison of the one that is chosen. */

import { comparisonOf } from "../api/comparison";
import { explain, untilAnswered } from "../api/client";
import { describeScene } from "../api/scenes";
import { service } from "../shell/service.svelte";

const POLL_MS = 700;
const MOST_ASKED = 40; // scenes

/** Has the service compare another scene with its held-out frames, too, until that is done. */
export class Rival {
  isReady = $state(false);
  problem = $state<string | null>(null);

  /** Follows `scene`; null: none. Must be made while a component is being made; ends with it. */
  constructor(scene: () => string | null) {
    $effect(() => {
      const wanted = scene();
      this.isReady = false;
      this.problem = null;
      if (wanted === null) return;
      const ending = new AbortController();
      const tell = (error: unknown): void => {
        if (!ending.signal.aborted) this.problem = explain(error);
      };
      this.#follow(wanted, tell, ending.signal).catch(tell);
      return () => ending.abort();
    });
  }

  async #follow(scene: string, tell: (error: unknown) => void, signal: AbortSignal): Promise<void> {
    for (;;) {
      const { state, reason } = await untilAnswered(() => comparisonOf(scene, signal), tell, signal);
      if (signal.aborted) return;
      this.isReady = state === "ready";
      this.problem = reason;
      if (state !== "running") return;
      await new Promise((resolve) => setTimeout(resolve, POLL_MS));
    }
  }
}

/** The names of the other scenes that were trained from the same sweep. */
export async function scenesOfSameSweep(scene: string): Promise<string[]> {
  const { dataset_sha256: sweep } = await describeScene(scene);
  const others = service.scenes.filter((one) => one.error == null && one.name !== scene).slice(0, MOST_ASKED);
  const described = await Promise.all(others.map(({ name }) => describeScene(name).catch(() => null)));
  return others.filter((_, place) => sweep !== null && described[place]?.dataset_sha256 === sweep).map(({ name }) => name);
}
