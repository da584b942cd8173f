/** A real frame of a file: whether it can be read, and whether it has the layout that a search needs. */

import { areUpright, type ImagePlane } from "../geometry/plane";
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
