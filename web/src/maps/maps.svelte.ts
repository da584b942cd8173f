/** What a person looks at in Maps of a scene: the large map and the cursor. Kept while other views are shown, and in the address. */

import { untrack } from "svelte";

import { OUTPUTS, type Output } from "../api/outputs";
import type { PlanePoint } from "../geometry/plane";
import { Calm } from "../shared/calm.svelte";
import { router, type Kept } from "../shell/router.svelte";
import { poseOrNull, poseValue } from "../session/link";
import type { Session } from "../session/session.svelte";

const BETWEEN = "_"; // stands in addresses as it is
const FIRST: Output = "bmode";

export class MapsState {
  large = $state<Output>(FIRST);
  /** In the image plane, so that it stays where it is when the picture changes. */
  cursor = $state.raw<PlanePoint | null>(null);

  constructor(readonly session: Session) {}

  /** Follows the address, and is kept in it. Must be called while a component is being made; ends with it. */
  live(): void {
    let opened = false;
    const pose = new Calm(() => this.session.pose);
    const startsAt = untrack(() => router.kept);
    $effect(() => {
      if (!this.session.scene.known) return;
      void router.arrivals;
      untrack(() => {
        // An address that tells nothing is the way back from another view, unless one came to it within this one.
        const kept = opened ? router.kept : startsAt;
        if (opened || Object.keys(kept).length > 0) this.#take(kept);
        opened = true;
      });
    });
    $effect(() => {
      if (!this.session.scene.known) return;
      const written = poseValue(pose.value);
      const home = poseValue(this.session.held(this.session.scene.home));
      const { cursor, large } = this;
      untrack(() => {
        const { view, name } = router.route;
        if (view !== "maps" || name !== this.session.name) return; // the address changes before the view goes
        router.keep({
          map: large === FIRST ? null : large,
          cursor: cursor && joined([cursor.x_mm, cursor.z_mm], 2),
          pose: written === home ? null : written,
        });
      });
    });
  }

  #take(kept: Kept): void {
    this.large = kept.map !== undefined && kept.map in OUTPUTS ? (kept.map as Output) : FIRST;
    const [x_mm, z_mm] = numbersOf(kept.cursor, 2) ?? [];
    this.cursor = x_mm === undefined || z_mm === undefined ? null : { x_mm, z_mm };
    const pose = poseOrNull(kept.pose);
    if (pose !== null) this.session.pose = pose;
    else if (poseValue(this.session.pose) !== poseValue(this.session.held(this.session.scene.home))) this.session.goHome();
  }
}

function joined(numbers: readonly number[], digits: number): string {
  return numbers.map((value) => String(Number(value.toFixed(digits)))).join(BETWEEN);
}

function numbersOf(text: string | undefined, count: number): number[] | null {
  const parts = text?.split(BETWEEN) ?? [];
  const numbers = parts.map(Number);
  return parts.length === count && !parts.includes("") && numbers.every(Number.isFinite) ? numbers : null;
}

const states = new WeakMap<Session, MapsState>();

/** What is looked at of a session; the same each time that Maps are shown. */
export function mapsOf(session: Session): MapsState {
  let state = states.get(session);
  if (state === undefined) states.set(session, (state = new MapsState(session)));
  return state;
}
