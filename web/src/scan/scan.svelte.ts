/** What is kept of the Scan view of each scene while another view is shown: the frozen frames and the measurements. */

import type { Session } from "../session/session.svelte";
import { sessionOf } from "../session/session.svelte";
import { Callipers } from "./callipers.svelte";
import { CineLoop } from "./cine.svelte";

export class ScanState {
  readonly session: Session;
  readonly cine = new CineLoop();
  readonly callipers = new Callipers();

  constructor(scene: string) {
    this.session = sessionOf(scene);
  }
}

const scans = new Map<string, ScanState>();

/** What is kept of a scene. A session that was forgotten begins anew. */
export function scanOf(scene: string): ScanState {
  const known = scans.get(scene);
  if (known !== undefined && known.session === sessionOf(scene)) return known;
  const begun = new ScanState(scene);
  scans.set(scene, begun);
  return begun;
}
