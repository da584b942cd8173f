/** The part of an image that shows ultrasound: whole pixels, the ends left out, written "188:632,12:600". */

export interface Crop {
  left: number;
  right: number;
  top: number;
  bottom: number;
}

export interface Size {
  width: number;
  height: number;
}

export type Edge = keyof Crop;

export function whole({ width, height }: Size): Crop {
  return { left: 0, right: width, top: 0, bottom: height };
}

export function writeCrop({ left, right, top, bottom }: Crop): string {
  return `${left}:${right},${top}:${bottom}`;
}

/** The edges that a person wrote, wherever they lie; null where they are not written as a crop is. */
export function readEdges(text: string, size: Size): Crop | null {
  const match = /^\s*(\d*):(\d*)\s*,\s*(\d*):(\d*)\s*$/.exec(text);
  if (match === null) return null;
  const numbers = [0, size.width, 0, size.height].map((otherwise, i) => (match[i + 1] === "" ? otherwise : Number(match[i + 1])));
  const [left, right, top, bottom] = numbers as [number, number, number, number];
  return { left, right, top, bottom };
}

/** The crop that a person wrote, as the service reads it; null where it is none of an image of this size. */
export function readCrop(text: string, size: Size): Crop | null {
  const crop = readEdges(text, size);
  return crop !== null && holds(crop, size) ? crop : null;
}

/** Whether a crop lies in the image and holds a pixel. */
export function holds({ left, right, top, bottom }: Crop, { width, height }: Size): boolean {
  return left >= 0 && left < right && right <= width && top >= 0 && top < bottom && bottom <= height;
}

/** The crop between two corners, at least a pixel wide, within the image. */
export function between(from: { x: number; y: number }, to: { x: number; y: number }, { width, height }: Size): Crop {
  const [left, right] = span(from.x, to.x, width);
  const [top, bottom] = span(from.y, to.y, height);
  return { left, right, top, bottom };
}

/** The crop with some of its edges moved by whole pixels, as far as the image and a width of one pixel let them. */
export function moved(crop: Crop, edges: readonly Edge[], across: number, down: number, size: Size): Crop {
  const next = { ...crop };
  if (edges.length === 4) {
    const x = within(across, -crop.left, size.width - crop.right);
    const y = within(down, -crop.top, size.height - crop.bottom);
    return { left: crop.left + x, right: crop.right + x, top: crop.top + y, bottom: crop.bottom + y };
  }
  if (edges.includes("left")) next.left = within(crop.left + across, 0, crop.right - 1);
  if (edges.includes("right")) next.right = within(crop.right + across, crop.left + 1, size.width);
  if (edges.includes("top")) next.top = within(crop.top + down, 0, crop.bottom - 1);
  if (edges.includes("bottom")) next.bottom = within(crop.bottom + down, crop.top + 1, size.height);
  return next;
}

function span(from: number, to: number, most: number): [number, number] {
  const low = within(Math.floor(Math.min(from, to)), 0, most - 1);
  return [low, within(Math.ceil(Math.max(from, to)), low + 1, most)];
}

function within(value: number, low: number, high: number): number {
  return Math.max(low, Math.min(high, value));
}
