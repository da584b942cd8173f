/** Where to look next: what is asked for, and the views that the service has planned. */

import { explain } from "../api/client";
import { defaultsOf } from "../api/described";
import { planSettings } from "../api/generated/contract";
import { type Planned, planViews } from "../api/rendering";
import { besideSession, type Session } from "../session/session.svelte";

/** A plan of a session, kept while other views are shown. */
export class Planning {
  settings = $state.raw<Record<string, unknown>>(defaultsOf(planSettings));
  /** Whether the way begins where the probe is. */
  fromHere = $state(true);
  planned = $state.raw<Planned | null>(null);
  /** Its views as the 3D view takes them. */
  readonly views = $derived(this.planned?.views.map(({ pose, gain }) => ({ pose: pose.flat(), gain })) ?? []);
  isRunning = $state(false);
  problem = $state<string | null>(null);
  #ending = new AbortController();

  constructor(private readonly session: Session) {}

  /** Plans anew. */
  async start(): Promise<void> {
    const { session, settings, fromHere } = this;
    this.stop();
    this.problem = null;
    this.isRunning = true;
    const { signal } = (this.#ending = new AbortController());
    try {
      const probe = session.chosenProbe;
      this.planned = await planViews(session.name, { ...settings, probe }, fromHere ? session.pose : null, signal);
    } catch (error) {
      if (!signal.aborted) this.problem = explain(error);
    } finally {
      if (!signal.aborted) this.isRunning = false;
    }
  }

  stop(): void {
    this.#ending.abort();
    this.isRunning = false;
  }

  forget(): void {
    this.stop();
    this.planned = null;
  }
}

/** That of a session; the same for every view. */
export const planningOf = besideSession((session) => new Planning(session));
