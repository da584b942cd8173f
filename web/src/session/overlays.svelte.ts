/** What is drawn over the image of a session, and which outputs that takes. */

import type { Output } from "../api/outputs";
import type { Frame } from "../api/stream";
import { toneOf } from "./familiar";
import type { Session } from "./session.svelte";

const NEARLY_ALL = 0.995; // of the pixels with support: there is nothing to hatch

export class Overlays {
  /** Hatches what no Gaussians support, of views that are guesses: in a view of the sweep, that is black tissue or shadow. */
  hatch = $state(true);
  uncertainty = $state(false);
  /** Times and losses of frames. */
  latency = $state(false);
  #hasGaps = $state(false);

  constructor(private readonly session: Session) {}

  get knowsUncertainty(): boolean {
    return this.session.scene.description?.outputs.includes("uncertainty") ?? false;
  }

  /** What must come beside the image: coverage only while there is something to hatch. */
  get outputs(): Output[] {
    const wanted: Output[] = [];
    if (this.hatch && this.#hasGaps) wanted.push("coverage");
    if (this.uncertainty && this.knowsUncertainty) wanted.push("uncertainty");
    return wanted;
  }

  /** Takes note of a frame that was shown. */
  shown(frame: Frame): void {
    this.#hasGaps = hasGaps(frame);
  }
}

/** Whether a frame is a guess that lacks support somewhere. */
export function hasGaps({ header: { extrapolation } }: Frame): boolean {
  return toneOf(extrapolation) !== "good" && (extrapolation.supported_share ?? 1) < NEARLY_ALL;
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
