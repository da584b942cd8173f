/** The last frames of one setting, kept for looking at again: at most so many, and so many bytes. */

import type { Frame } from "../api/stream";

const MOST_FRAMES = 180;
const MOST_BYTES = 64 * 2 ** 20;
export const PLAYED_PER_SECOND = 20;

/** Frames that were put by, with the one that was shown. */
export interface Loop {
  frames: readonly Frame[];
  index: number;
}

export class CineLoop {
  playing = $state(false);
  /** Frames of the loop that stands, and which of them is shown. */
  count = $state(0);
  index = $state(0);
  current = $state.raw<Frame | null>(null);
  #frames: Frame[] = [];
  #bytes = 0;
  #settings = "";
  #timer: ReturnType<typeof setInterval> | undefined;

  /** `shown` hears of each frame of the loop that is shown. */
  constructor(private readonly shown: (frame: Frame) => void) {}

  get frames(): readonly Frame[] {
    return this.#frames;
  }

  /** Takes a live frame; the oldest ones go, and all of them where the settings are others: as on a scanner. */
  push(frame: Frame): void {
    const settings = settingsOf(frame);
    if (settings !== this.#settings) this.clear();
    this.#settings = settings;
    this.#frames.push(frame);
    this.#bytes += frame.pixels.byteLength;
    while (this.#frames.length > MOST_FRAMES || (this.#bytes > MOST_BYTES && this.#frames.length > 1))
      this.#bytes -= this.#frames.shift()!.pixels.byteLength;
  }

  clear(): void {
    this.pause();
    this.#frames = [];
    this.#bytes = 0;
    this.count = this.index = 0;
    this.current = null;
  }

  /** Lets the loop stand at its newest frame. */
  stand(): void {
    this.count = this.#frames.length;
    this.show(this.count - 1);
  }

  putBy(): Loop {
    return { frames: [...this.#frames], index: this.index };
  }

  restore({ frames, index }: Loop): void {
    this.clear();
    for (const frame of frames) this.push(frame);
    this.count = frames.length;
    this.show(index);
  }

  show(index: number): void {
    const frame = this.#frames[index];
    if (frame === undefined) return;
    this.index = index;
    this.current = frame;
    this.shown(frame);
  }

  /** Goes on by so many frames, all around. */
  step(by: number): void {
    if (this.count > 0) this.show((this.index + by + this.count) % this.count);
  }

  togglePlaying(): void {
    if (this.playing) return this.pause();
    this.playing = true;
    this.#timer = setInterval(() => this.step(1), 1000 / PLAYED_PER_SECOND);
  }

  pause(): void {
    clearInterval(this.#timer);
    this.playing = false;
  }
}

function settingsOf({ header }: Frame): string {
  const { scene_sha256, probe, slice_thickness_mm, display, height, width } = header;
  return JSON.stringify([scene_sha256, probe, slice_thickness_mm, display, height, width]);
}
