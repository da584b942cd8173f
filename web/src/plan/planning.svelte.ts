/** Where to look next: what is asked for, and the views that the service has planned. */

import { defaultsOf } from "../api/described";
import { planSettings } from "../api/generated/contract";
import { type Planned, planViews } from "../api/rendering";
import { besideSession, type Session } from "../session/session.svelte";
import { Attempt } from "../shared/asking.svelte";

/** A plan of a session, kept while other views are shown. */
export class Planning extends Attempt {
  settings = $state.raw<Record<string, unknown>>(defaultsOf(planSettings));
  /** Whether the way begins where the probe is. */
  fromHere = $state(true);
  planned = $state.raw<Planned | null>(null);
  /** Its views as the 3D view takes them. */
  readonly views = $derived(this.planned?.views.map(({ pose, gain }) => ({ pose: pose.flat(), gain })) ?? []);

  constructor(private readonly session: Session) {
    super();
  }

  /** Plans anew. */
  async start(): Promise<void> {
    const { session, settings, fromHere } = this;
    const probe = session.chosenProbe;
    await this.run(async (signal) => {
      this.planned = await planViews(session.name, { ...settings, probe }, fromHere ? session.pose : null, signal);
    });
  }

  forget(): void {
    this.stop();
    this.planned = null;
  }
}

/** That of a session; the same for every view. */
export const planningOf = besideSession((session) => new Planning(session));
