/** Distances measured in the image, in mm of the image plane. */

import { distanceBetween_mm } from "../geometry/picture";
import type { PlanePoint } from "../geometry/plane";

export interface Calliper {
  a: PlanePoint;
  b: PlanePoint;
}

const MOST = 4;
const KEYBOARD_MM = 10;

export class Callipers {
  /** Whether a press on the image sets a point. */
  measuring = $state(false);
  all = $state.raw<Calliper[]>([]);

  /** Begins a measurement; the oldest goes where there are too many. */
  begin(at: PlanePoint): void {
    this.all = [...this.all, { a: at, b: at }].slice(-MOST);
  }

  /** Begins one of KEYBOARD_MM about a point, for ends that are moved by keys. */
  beginAbout({ x_mm, z_mm }: PlanePoint): void {
    this.begin({ x_mm: x_mm - KEYBOARD_MM / 2, z_mm });
    this.move(this.all.length - 1, "b", { x_mm: x_mm + KEYBOARD_MM / 2, z_mm });
  }

  /** Takes the newest measurement back. */
  dropNewest(): void {
    this.all = this.all.slice(0, -1);
  }

  /** Moves an end of a measurement. */
  move(index: number, end: "a" | "b", to: PlanePoint): void {
    this.all = this.all.map((one, i) => (i === index ? { ...one, [end]: to } : one));
  }

  clear(): void {
    this.all = [];
  }
}

export function length_mm({ a, b }: Calliper): number {
  return distanceBetween_mm(a, b);
}
