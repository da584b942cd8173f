/** The last frames, kept for looking at again: at most so many, and so many bytes. */

import type { Frame } from "../api/stream";

const MOST_FRAMES = 180;
const MOST_BYTES = 64 * 2 ** 20;
const PLAYED_PER_SECOND = 20;

export class CineLoop {
  /** Whether the image stands. */
  frozen = $state(false);
  playing = $state(false);
  count = $state(0);
  /** Of the frame shown while frozen. */
  index = $state(0);
  #frames: Frame[] = [];
  #bytes = 0;
  #timer: ReturnType<typeof setInterval> | undefined;

  /** Takes a live frame; the oldest ones go. */
  push(frame: Frame): void {
    if (this.frozen) return;
    this.#frames.push(frame);
    this.#bytes += frame.pixels.byteLength;
    while (this.#frames.length > MOST_FRAMES || (this.#bytes > MOST_BYTES && this.#frames.length > 1))
      this.#bytes -= this.#frames.shift()!.pixels.byteLength;
  }

  freeze(): void {
    this.frozen = true;
    this.count = this.#frames.length;
    this.index = Math.max(0, this.count - 1);
  }

  unfreeze(): void {
    this.pause();
    this.frozen = false;
  }

  /** The frame to show while frozen. */
  get current(): Frame | null {
    return this.#frames[this.index] ?? null;
  }

  play(): void {
    this.playing = true;
    this.#timer = setInterval(() => {
      if (this.count > 0) this.index = (this.index + 1) % this.count;
    }, 1000 / PLAYED_PER_SECOND);
  }

  pause(): void {
    clearInterval(this.#timer);
    this.playing = false;
  }
}
