/** Frames that several workers draw: each has a copy of the scene, and draws some scan lines of the planes.
 *
 * Copies need no memory that workers share, which a page has only where it is isolated from all others, and the frames are
 * the same to the bit. Each worker finds anew which Gaussians the plane cuts; the first one turns the planes into the frame.
 */

import { wantedPlanes, type Library, type Rendered } from "./library.js";
import { Asker, type Wish } from "./thread.js";
import type { Answer, LoadRequest } from "./worker.js";

const MOST_WAIT_MS = 3000; // for helpers, whose shares are as large as the first worker's, once that has drawn its own
const STRIP = 64; // shares of scan lines end at multiples of it, or at the last one (ultragray_draw)

export class Crew {
  #helpers: Asker[] | undefined; // undefined: no frame was wide enough yet
  #ready: Asker[] = []; // those that have the scene
  #settings = new Map<number, string>(); // of views
  #newest: Promise<unknown> = Promise.resolve(); // frame

  constructor(
    private readonly library: Library,
    /** Of the scene, for the helpers. */
    private readonly request: LoadRequest,
  ) {}

  prepare(view: number, settings: string): void {
    this.#settings.set(view, settings);
    for (const helper of this.#ready) prepare(helper, view, settings);
  }

  freeView(view: number): void {
    this.#settings.delete(view);
    for (const helper of this.#ready) helper.ask({ act: "freeView", view }).catch(() => undefined);
  }

  /** The frame of a pose and a view, `at` in the library, and how many drew it; undefined where there are no helpers for it.
   *
   * One frame after another, so that answers are taken while they are waited for. A helper that fails, as where its memory
   * does not suffice, or does not answer is dropped, and the first worker draws its lines, too.
   */
  render(view: number, at: number, pose: readonly number[]): Promise<(Rendered & { workers: number }) | undefined> {
    const frame = this.#newest.then(() => this.#render(view, at, pose));
    this.#newest = frame.catch(() => undefined);
    return frame;
  }

  async #render(view: number, at: number, pose: readonly number[]): Promise<(Rendered & { workers: number }) | undefined> {
    const plan = this.library.plan(at, pose);
    const { height, width } = plan;
    const strips = Math.ceil(width / STRIP);
    if (strips > 1) this.#start();
    const helpers = this.#ready.slice(0, strips - 1);
    if (helpers.length === 0) return undefined;
    const rows = height * wantedPlanes(plan).filter(Boolean).length;
    const end = (share: number): number => Math.min(width, STRIP * Math.round((share * strips) / (helpers.length + 1)));
    const lines = [0, ...helpers].map((_, share) => ({ first: end(share), end: end(share + 1), floats: rows * (end(share + 1) - end(share)) }));
    const asked = helpers.map((helper, number) => helper.ask<Float32Array>({ act: "draw", view, pose, ...lines[number + 1]! }).catch(() => undefined));
    const own = this.library.draw(at, pose, lines[0]!);
    let timer;
    const late = new Promise<undefined>((resolve) => (timer = setTimeout(resolve, MOST_WAIT_MS)));
    const drawn = await Promise.all(asked.map((part) => Promise.race([part, late])));
    clearTimeout(timer);
    helpers.filter((_, number) => !drawn[number]).forEach((helper) => this.#drop(helper));
    const whole = new Float32Array(rows * width);
    [own, ...drawn].forEach((part, share) => {
      const { first, end } = lines[share]!;
      part ??= this.library.draw(at, pose, lines[share]!);
      for (let row = 0, size = end - first; row < rows; row++) whole.set(part.subarray(row * size, (row + 1) * size), row * width + first);
    });
    return { ...this.library.finish(at, pose, whole), workers: 1 + drawn.filter(Boolean).length };
  }

  #drop(helper: Asker): void {
    this.#ready = this.#ready.filter((one) => one !== helper);
    wish({ dropped: this.#helpers!.indexOf(helper) });
    helper.end(new Error("the helper was dropped"));
  }

  #start(): void {
    if (this.#helpers !== undefined) return;
    const channels = Array.from({ length: this.request.workers - 1 }, () => new MessageChannel());
    wish({ helpers: channels.map(({ port2 }) => port2) });
    this.#helpers = channels.map(({ port1 }) => {
      const helper = new Asker(port1);
      port1.onmessage = ({ data }: MessageEvent<Answer>) => helper.take(data);
      const ready = (): void => {
        for (const [view, settings] of this.#settings) prepare(helper, view, settings);
        this.#ready.push(helper);
      };
      helper.ask({ ...this.request, workers: 1 }).then(ready, () => this.#drop(helper));
      return helper;
    });
  }
}

function wish(wanted: Wish): void {
  postMessage(wanted, { transfer: "helpers" in wanted ? wanted.helpers : [] });
}

function prepare(helper: Asker, view: number, settings: string): void {
  helper.ask({ act: "prepare", view, settings }).catch(() => undefined); // the first worker tells what is wrong
}
