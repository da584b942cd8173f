/** A search for where a real frame was taken, kept while other views are shown. */

import { explain } from "../api/client";
import { localize, WITHIN, type Located, type Within } from "../api/localization";
import { renderPicture } from "../api/rendering";
import type { Pose } from "../geometry/pose";
import type { Session } from "../session/session.svelte";
import { base64 } from "../shared/base64";
import { readFrame, type RealFrame } from "./frame_file";

export class Search {
  within = $state.raw(Object.fromEntries(WITHIN.map(({ name, field }) => [name, field.default])) as unknown as Within);
  frame = $state.raw<RealFrame | null>(null);
  /** Addresses of the given frame and of the scene at the pose that was found. */
  given = $state<string | null>(null);
  rendered = $state<string | null>(null);
  located = $state.raw<Located | null>(null);
  isRunning = $state(false);
  problem = $state<string | null>(null);
  #ending = new AbortController();
  #newest: File | null = null;

  constructor(private readonly session: Session) {}

  get pose(): Pose | null {
    return this.located && this.located.pose.flat();
  }

  /** Takes the frame of a file in the place of the one before. */
  async take(file: File): Promise<void> {
    this.stop();
    this.problem = null;
    this.#newest = file;
    try {
      const frame = await readFrame(file);
      if (this.#newest !== file) return; // another one was given meanwhile
      this.stop();
      this.#forgetResult();
      this.frame = frame;
      this.#replace("given", file);
    } catch (error) {
      if (this.#newest === file) this.problem = explain(error);
    }
  }

  /** Looks for the frame about where the probe is now. */
  async start(): Promise<void> {
    if (this.frame === null) return;
    const { session, within, frame } = this;
    this.stop();
    this.#forgetResult();
    this.problem = null;
    this.isRunning = true;
    const { signal } = (this.#ending = new AbortController());
    try {
      const [start, probe] = [session.pose, session.chosenProbe];
      const located = await localize(session.name, { image: base64(frame.bytes), start, probe, ...within }, signal);
      this.located = located;
      const { picture } = await renderPicture(session.name, located.pose.flat(), { probe }, signal);
      this.#replace("rendered", picture);
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

  #forgetResult(): void {
    this.located = null;
    this.#replace("rendered", null);
  }

  #replace(which: "given" | "rendered", picture: Blob | null): void {
    const before = this[which];
    if (before !== null) URL.revokeObjectURL(before);
    this[which] = picture && URL.createObjectURL(picture);
  }
}

const known = new WeakMap<Session, Search>();

/** That of a session; the same for every view. */
export function searchOf(session: Session): Search {
  const before = known.get(session);
  if (before !== undefined) return before;
  const begun = new Search(session);
  known.set(session, begun);
  return begun;
}
