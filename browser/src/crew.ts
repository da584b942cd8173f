/** Frames that several workers draw: each has a copy of the scene, and draws some scan lines of the planes.
 *
 * Copies need no memory that workers share, which a page has only where it is isolated from all others, and the frames are
 * the same to the bit. Each worker finds anew which Gaussians the plane cuts; the first one turns the planes into the frame.
 */

import type { Library, Rendered } from "./library.js";
import { Thread } from "./thread.js";
import type { LoadRequest } from "./worker.js";

const STRIP = 64; // shares of scan lines end at multiples of it, or at the last one (ultragray_draw)

export class Crew {
  #helpers: Thread[] | undefined; // undefined: no frame was wide enough yet
  #ready: Thread[] = []; // those that have the scene
  #settings = new Map<number, string>(); // of views

  constructor(
    private readonly library: Library,
    /** Of the scene, for the helpers. */
    private readonly request: LoadRequest,
  ) {}

  prepare(view: number, settings: string): void {
    this.#settings.set(view, settings);
    for (const thread of this.#ready) prepare(thread, view, settings);
  }

  freeView(view: number): void {
    this.#settings.delete(view);
    for (const thread of this.#ready) thread.ask({ act: "freeView", view }).catch(() => undefined);
  }

  /** The frame of a pose and a view, `at` in the library, and how many drew it; undefined where there are no helpers for it. */
  async render(view: number, at: number, pose: readonly number[]): Promise<(Rendered & { workers: number }) | undefined> {
    const { height, width, planes } = this.library.plan(at, pose);
    const strips = Math.ceil(width / STRIP);
    if (strips > 1) this.#start();
    const helpers = this.#ready.slice(0, strips - 1);
    if (helpers.length === 0) return undefined;
    const rows = height * planes.filter(Boolean).length;
    const end = (share: number): number => Math.min(width, STRIP * Math.round((share * strips) / (helpers.length + 1)));
    const lines = [0, ...helpers].map((_, share) => ({ first: end(share), end: end(share + 1), floats: rows * (end(share + 1) - end(share)) }));
    const drawn = helpers.map((thread, number) => thread.ask<Float32Array>({ act: "draw", view, pose, ...lines[number + 1]! }));
    try {
      const own = async (): Promise<Float32Array> => this.library.draw(at, pose, lines[0]!);
      const parts = await Promise.all([own(), ...drawn]);
      const whole = new Float32Array(rows * width);
      parts.forEach((part, share) => {
        const { first, end } = lines[share]!;
        for (let row = 0, size = end - first; row < rows; row++) whole.set(part.subarray(row * size, (row + 1) * size), row * width + first);
      });
      return { ...this.library.finish(at, pose, whole), workers: parts.length };
    } catch (error) {
      for (const thread of this.#ready.splice(0)) thread.close(); // its memory does not suffice, or it has ended
      throw error;
    }
  }

  #start(): void {
    this.#helpers ??= Array.from({ length: this.request.workers - 1 }, () => {
      const thread = new Thread();
      const ready = (): void => {
        for (const [view, settings] of this.#settings) prepare(thread, view, settings);
        this.#ready.push(thread);
      };
      thread.ask({ ...this.request, workers: 1 }).then(ready, () => thread.close());
      return thread;
    });
  }
}

function prepare(thread: Thread, view: number, settings: string): void {
  thread.ask({ act: "prepare", view, settings }).catch(() => undefined); // the first worker tells what is wrong
}
