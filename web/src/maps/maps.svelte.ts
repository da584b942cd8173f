/** What a person looks at in Maps of a scene: its outputs and labels, the large map and the cursor, kept in the address. */

import { untrack } from "svelte";

import { type Output, OUTPUTS } from "../api/contract";
import type { PlanePoint } from "../geometry/plane";
import { type Kept, router } from "../page/router.svelte";
import { joined, numbersIn, poseOrNull, poseValue } from "../session/link";
import { besideSession, type Session } from "../session/session.svelte";
import { Calm } from "../shared/asking.svelte";
import { nameIn } from "../shared/text";
import { words } from "../words/words.svelte";

/** A pixel of the frame. */
export interface Cursor {
  column: number;
  row: number;
}

const LABELS: Output = "labels";

/** The outputs of a scene; labels are among them as soon as there is a tool in its image. */
export function outputsOf({ scene, tools }: Session): Output[] {
  const outputs = scene.description?.outputs ?? [];
  return tools.all.length === 0 || outputs.includes(LABELS) ? outputs : [...outputs, LABELS];
}

/** Names by label; what is both tissue and a tool has both names. */
export function labelNamesOf({ scene, tools }: Session): Record<string, string> {
  const names: Record<string, string[]> = {};
  for (const [label, name] of Object.entries(scene.description?.label_names ?? {})) names[label] = [name];
  for (const { kind, label } of tools.all) {
    const known = (names[label] ??= []);
    const name = nameIn(words.tools.kinds, kind);
    if (!known.includes(name)) known.push(name);
  }
  return Object.fromEntries(Object.entries(names).map(([label, known]) => [label, known.join(", ")]));
}

const FIRST: Output = "bmode";

/** What a person looks at in Maps of a scene: the large map and the cursor. Kept while other views are shown, and in the address. */
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
    const [x_mm, z_mm] = numbersIn(kept.cursor ?? "", 2) ?? [];
    this.cursor = x_mm === undefined || z_mm === undefined ? null : { x_mm, z_mm };
    const pose = poseOrNull(kept.pose);
    if (pose !== null) this.session.pose = pose;
    else if (poseValue(this.session.pose) !== poseValue(this.session.held(this.session.scene.home))) this.session.goHome();
  }
}

/** What is looked at of a session; the same each time that Maps are shown. */
export const mapsOf = besideSession((session) => new MapsState(session));
