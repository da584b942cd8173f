/** What is kept of the Scan view of each scene while another view is shown: the frozen frames with what was set on them. */

import type { Session } from "../session/session.svelte";
import { sessionOf } from "../session/session.svelte";
import { CineLoop, type Loop } from "./cine.svelte";
import { Marks, type Mark, type MarkKind } from "./marks.svelte";

export class ScanState {
  readonly session: Session;
  readonly cine: CineLoop;
  readonly marks: Marks;

  constructor(scene: string) {
    const session = (this.session = sessionOf(scene));
    this.cine = new CineLoop((frame) => session.lookAt(frame.header.pose.flat()));
    this.marks = new Marks(session.history);
  }

  /** Lets the newest frame stand, with the probe where it was taken. */
  freeze(): void {
    const { session, cine } = this;
    const newest = cine.frames.at(-1);
    if (session.frozen || newest === undefined) return;
    const before = session.pose;
    this.#forgetFrozen();
    session.freeze(newest.header.pose.flat());
    cine.stand();
    const loop = cine.putBy();
    session.history.add({ undo: () => this.#release(before), redo: () => this.#hold(loop, []), of: this });
  }

  /** Goes on live from where the frame shown was taken; what was measured goes with the frames. */
  unfreeze(): void {
    const { session, cine, marks } = this;
    if (!session.frozen) return;
    const [loop, set] = [cine.putBy(), marks.all];
    this.#release();
    session.history.add({ undo: () => this.#hold(loop, set), redo: () => this.#release(), of: this });
  }

  toggleFrozen(): void {
    if (this.session.frozen) this.unfreeze();
    else this.freeze();
  }

  /** Takes a tool up, or lays it down. What is measured stands still: it freezes. */
  toggleTool(kind: MarkKind): void {
    this.marks.draft = null;
    this.freeze();
    this.marks.tool = this.marks.tool === kind || !this.session.frozen ? null : kind;
  }

  /** The marks of the frame that is shown, the one that is being set among them. */
  get shown(): readonly Mark[] {
    if (!this.session.frozen) return [];
    const { all, draft } = this.marks;
    return [...all, ...(draft === null ? [] : [draft.mark])].filter(({ frame }) => frame === this.cine.index);
  }

  /** Lets go of what stood, where the scene has become another one. */
  forget(): void {
    this.#forgetFrozen();
    this.#clear();
  }

  #hold(loop: Loop, marks: readonly Mark[]): void {
    this.session.freeze(loop.frames[loop.index]!.header.pose.flat());
    this.cine.restore(loop);
    this.marks.restore(marks);
  }

  #release(pose = this.session.pose): void {
    this.#clear();
    this.session.unfreeze(pose);
  }

  #clear(): void {
    this.cine.clear();
    this.marks.restore([]);
    this.marks.tool = null;
  }

  /** Only the newest frozen loop can be had back: they are large. */
  #forgetFrozen(): void {
    this.session.history.forget(this);
    this.session.history.forget(this.marks);
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
