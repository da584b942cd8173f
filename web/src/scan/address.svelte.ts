/** The address of Scan: what a reload, a sent link or a step back brings back. */

import { untrack } from "svelte";

import { router } from "../page/router.svelte";
import { followLink, isAsLinked, isLink, linkOf } from "../session/link";
import type { ScanState } from "./scan.svelte";

const WRITTEN_EVERY_MS = 250;

type Values = Record<string, string | null>;

export class Address {
  /** What of the address that was opened cannot be used. */
  refused = $state.raw<readonly string[]>([]);
  /** Whether the session is what the address told when the view was opened. */
  #taken = $state(false);
  #arrivals: number | null = null;
  #jumps = 0;
  #latest: Values = {};
  #timer: ReturnType<typeof setTimeout> | undefined;

  /** Must be made while a component is being made; ends with it. */
  constructor(private readonly scan: ScanState) {
    const { session } = scan;
    $effect(() => {
      if (!session.scene.known) return;
      const { arrivals } = router;
      untrack(() => void this.#take(arrivals));
    });
    $effect(() => {
      if (!session.scene.known || !this.#taken) return;
      const [values, jumps] = [linkOf(session), session.jumps];
      untrack(() => this.#note(values, jumps));
    });
    $effect(() => () => clearTimeout(this.#timer));
  }

  /** The whole address of what is shown. */
  link(): string {
    this.#write();
    return new URL(router.link, location.href).href;
  }

  async #take(arrivals: number): Promise<void> {
    const opened = this.#arrivals === null;
    this.#arrivals = arrivals;
    if (!this.#isHere) return;
    const { session } = this.scan;
    const { kept } = router;
    // An address that tells nothing is the way back from another view, unless one came to it within this one.
    const follows = opened ? isLink(kept) : true;
    if (follows && !isAsLinked(session, kept)) {
      this.#taken = false;
      this.scan.unfreeze();
      this.refused = await followLink(session, kept);
    }
    this.#jumps = session.jumps;
    this.#latest = linkOf(session);
    this.#taken = true;
  }

  #note(values: Values, jumps: number): void {
    const isJump = jumps !== this.#jumps;
    this.#jumps = jumps;
    if (isJump && JSON.stringify(values) !== JSON.stringify(this.#latest)) {
      this.#write();
      this.#latest = values;
      if (this.#isHere) router.keep(values, { entry: true });
      return;
    }
    this.#latest = values;
    this.#timer ??= setTimeout(() => this.#write(), WRITTEN_EVERY_MS);
  }

  #write(): void {
    clearTimeout(this.#timer);
    this.#timer = undefined;
    if (this.#isHere) router.keep(this.#latest);
  }

  /** Whether the address is still that of this view: it changes before the view goes. */
  get #isHere(): boolean {
    const { view, name } = router.route;
    return view === "scan" && name === this.scan.session.name;
  }
}
