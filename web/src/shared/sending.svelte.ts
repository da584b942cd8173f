/** Files on their way to the service. They outlive the view that sends them; leaving the page asks first. */

import { explain } from "../api/client";
import type { Told } from "../api/upload";

export class Sending {
  /** Share of the bytes that were sent, 0 to 1; null: nothing is under way. */
  share = $state<number | null>(null);
  /** Why the last one was not taken. */
  problem = $state<string | null>(null);
  #ending = new AbortController();

  stop(): void {
    this.#ending.abort();
  }

  /** Sends one; null where it was stopped or refused. */
  protected async transfer<Answer>(
    send: (told: Told, signal: AbortSignal) => Promise<Answer>,
  ): Promise<Answer | null> {
    const { signal } = (this.#ending = new AbortController());
    const ask = (event: BeforeUnloadEvent): void => event.preventDefault();
    addEventListener("beforeunload", ask);
    this.problem = null;
    this.share = 0;
    try {
      return await send((share) => (this.share = share), signal);
    } catch (error) {
      if (!signal.aborted) this.problem = explain(error);
      return null;
    } finally {
      this.share = null;
      removeEventListener("beforeunload", ask);
    }
  }
}
