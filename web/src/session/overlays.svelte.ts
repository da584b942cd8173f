/** What is drawn over the image of a session, and which outputs that takes. */

import type { Output } from "../api/outputs";
import type { Frame } from "../api/stream";
import type { Session } from "./session.svelte";

const NEARLY_ALL = 0.995; // of the pixels with support: there is nothing to hatch

export class Overlays {
  /** Hatches what no Gaussians support. */
  hatch = $state(true);
  uncertainty = $state(false);
  /** Times and losses of frames. */
  latency = $state(false);
  #lacksSupport = $state(false);

  constructor(private readonly session: Session) {}

  get knowsUncertainty(): boolean {
    return this.session.description?.outputs.includes("uncertainty") ?? false;
  }

  /** What must come beside the image: coverage only while some of it is low. */
  get outputs(): Output[] {
    const wanted: Output[] = [];
    if (this.hatch && this.#lacksSupport) wanted.push("coverage");
    if (this.uncertainty && this.knowsUncertainty) wanted.push("uncertainty");
    return wanted;
  }

  /** Takes note of a frame that was shown. */
  shown({ header }: Frame): void {
    this.#lacksSupport = (header.extrapolation.supported_share ?? 1) < NEARLY_ALL;
  }
}

const known = new WeakMap<Session, Overlays>();

/** Those of a session; the same for every view. */
export function overlaysOf(session: Session): Overlays {
  const before = known.get(session);
  if (before !== undefined) return before;
  const begun = new Overlays(session);
  known.set(session, begun);
  return begun;
}
