/** The search for where a real frame was taken: the file, whether its layout fits, and what the service found. */

import { explain } from "../api/client";
import type { ImagePlane } from "../api/contract";
import { localize, type Located, renderPicture, WITHIN, type Within } from "../api/rendering";
import { areUpright } from "../geometry/plane";
import type { Pose } from "../geometry/pose";
import { besideSession, type Session } from "../session/session.svelte";
import { Attempt, base64 } from "../shared/asking.svelte";
import { words } from "../words/words.svelte";

const PNG = [0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a];
const CORNER = 0.1; // of the width and the height
const BLACK = 4; // of 255
const LIT = 24;

export interface RealFrame {
  name: string;
  bytes: Uint8Array;
  width: number;
  height: number;
  /** Whether it looks like a fan on a black ground, as a screen shows it. */
  isFan: boolean;
}

/** Reads a PNG file. Throws an Error in words. */
export async function readFrame(file: File): Promise<RealFrame> {
  const bytes = new Uint8Array(await file.arrayBuffer());
  if (!PNG.every((byte, index) => bytes[index] === byte)) throw new Error(words.locate.notPng(file.name));
  let bitmap: ImageBitmap;
  try {
    bitmap = await createImageBitmap(file);
  } catch {
    throw new Error(words.locate.damaged(file.name));
  }
  const { width, height } = bitmap;
  const drawing = new OffscreenCanvas(width, height).getContext("2d")!;
  drawing.drawImage(bitmap, 0, 0);
  bitmap.close();
  return { name: file.name, bytes, width, height, isFan: looksLikeFan(drawing.getImageData(0, 0, width, height)) };
}

/** Whether a frame was put on a screen before it was stored; of a probe whose lines are upright both are one. */
export function isScanConverted(frame: RealFrame, { lines_mm }: ImagePlane): boolean {
  return frame.isFan && !areUpright(lines_mm);
}

/** Black in both upper corners, and not so between them: where scan lines begin, they all show the skin. */
function looksLikeFan({ data, width, height }: ImageData): boolean {
  const [columns, rows] = [Math.ceil(width * CORNER), Math.ceil(height * CORNER)];
  const brightest = (left: number): number => {
    let most = 0;
    for (let y = 0; y < rows; y++)
      for (let x = left; x < left + columns; x++) most = Math.max(most, data[4 * (y * width + x)]!);
    return most;
  };
  const middle = Math.floor((width - columns) / 2);
  return brightest(0) < BLACK && brightest(width - columns) < BLACK && brightest(middle) > LIT;
}

/** A search for where a real frame was taken, kept while other views are shown. */
export class Search extends Attempt {
  within = $state.raw(Object.fromEntries(WITHIN.map(({ name, field }) => [name, field.default])) as unknown as Within);
  /** Looked for along the whole sweep, wherever the probe is. */
  anywhere = $state(false);
  frame = $state.raw<RealFrame | null>(null);
  /** Addresses of the given frame and of the scene at the pose that was found. */
  given = $state<string | null>(null);
  rendered = $state<string | null>(null);
  located = $state.raw<Located | null>(null);
  #newest: File | null = null;

  constructor(private readonly session: Session) {
    super();
  }

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

  /** Looks for the frame about where the probe is now, or anywhere. */
  async start(): Promise<void> {
    if (this.frame === null) return;
    const { session, within, frame, anywhere } = this;
    this.#forgetResult();
    await this.run(async (signal) => {
      const [start, probe] = [session.pose, session.chosenProbe];
      const about = anywhere ? { search: "anywhere" as const } : within;
      this.located = await localize(session.name, { image: base64(frame.bytes), start, probe, ...about }, signal);
      const { picture } = await renderPicture(session.name, this.located.pose.flat(), { probe }, signal);
      this.#replace("rendered", picture);
    });
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

/** That of a session; the same for every view. */
export const searchOf = besideSession((session) => new Search(session));
