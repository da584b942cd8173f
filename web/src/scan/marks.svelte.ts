/** What a person set on frozen frames: distances, ellipses, angles and texts, in mm of the image plane. */

import { carried, middleOf, squareTo, type EllipsePoints } from "../geometry/measure";
import type { PlanePoint } from "../geometry/plane";
import type { History } from "../session/history.svelte";

export const MARK_KINDS = ["distance", "ellipse", "angle", "text"] as const;
export type MarkKind = (typeof MARK_KINDS)[number];

export interface Mark {
  readonly id: number;
  readonly kind: MarkKind;
  /** Index in the cine loop of the frame that it lies on. */
  readonly frame: number;
  readonly points: readonly PlanePoint[];
  /** Of an annotation. */
  readonly text: string;
}

const POINTS: Record<MarkKind, number> = { distance: 2, ellipse: 3, angle: 3, text: 1 };
const KEYBOARD_MM = 5; // half of what is put down for keys to move
const SECOND_AXIS = 0.6; // of the first, until it is set

export class Marks {
  /** What a press on the image begins. */
  tool = $state<MarkKind | null>(null);
  all = $state.raw<readonly Mark[]>([]);
  /** The one whose points are being set: its points up to `next` stand, that one follows the pointer. */
  draft = $state.raw<{ mark: Mark; next: number } | null>(null);
  /** The annotation that is being written. */
  editing = $state<number | null>(null);
  #newest = 0;

  constructor(private readonly history: History) {}

  /** Begins one of the tool at a point. */
  begin(at: PlanePoint, frame: number): void {
    if (this.tool === null) return;
    const points = Array.from({ length: POINTS[this.tool] }, () => at);
    this.draft = { mark: this.#made(this.tool, frame, points), next: Math.min(1, points.length - 1) };
  }

  /** Leads the point that is being set. */
  lead(to: PlanePoint): void {
    if (this.draft === null) return;
    this.draft = { ...this.draft, mark: withPoint(this.draft.mark, this.draft.next, to) };
  }

  /** Sets that point where it is; the last one ends the mark. */
  settle(): void {
    if (this.draft === null) return;
    const { mark, next } = this.draft;
    if (next + 1 < mark.points.length) {
      this.draft = { mark: mark.kind === "ellipse" ? withSecondAxis(mark) : mark, next: next + 1 };
      return;
    }
    this.draft = null;
    this.#put([...this.all, mark]);
    if (mark.kind === "text") this.editing = mark.id;
  }

  /** Puts one of the tool about a point, for keys to move. */
  putAbout({ x_mm, z_mm }: PlanePoint, frame: number): Mark | null {
    if (this.tool === null) return null;
    const [left, right] = [x_mm - KEYBOARD_MM, x_mm + KEYBOARD_MM];
    const points = {
      distance: [{ x_mm: left, z_mm }, { x_mm: right, z_mm }],
      ellipse: [{ x_mm: left, z_mm }, { x_mm: right, z_mm }, { x_mm, z_mm: z_mm + SECOND_AXIS * KEYBOARD_MM }],
      angle: [{ x_mm: right, z_mm: z_mm - KEYBOARD_MM }, { x_mm: left, z_mm }, { x_mm: right, z_mm }],
      text: [{ x_mm, z_mm }],
    }[this.tool];
    const mark = this.#made(this.tool, frame, points);
    this.#put([...this.all, mark]);
    if (mark.kind === "text") this.editing = mark.id;
    return mark;
  }

  /** Moves a point; what is moved without a pause is undone as one step. */
  move(id: number, point: number, to: PlanePoint): void {
    const next = this.all.map((mark) => (mark.id === id ? withPoint(mark, point, to) : mark));
    this.#put(next, `mark ${id}.${point}`);
  }

  /** Writes an annotation; an empty one goes. */
  write(id: number, text: string): void {
    this.editing = null;
    const before = this.all.find((mark) => mark.id === id);
    if (before === undefined) return;
    if (text.trim() === "") this.remove(id);
    else if (text !== before.text) this.#put(this.all.map((mark) => (mark.id === id ? { ...mark, text: text.trim() } : mark)));
  }

  remove(id: number): void {
    this.#put(this.all.filter((mark) => mark.id !== id));
  }

  removeAll(): void {
    this.draft = null;
    if (this.all.length > 0) this.#put([]);
  }

  /** Leaves what is being done: first the mark that is being set, then the tool. */
  leave(): void {
    if (this.draft !== null) this.draft = null;
    else this.tool = null;
  }

  /** Takes others in place of all, which is no step of its own. */
  restore(marks: readonly Mark[]): void {
    this.all = marks;
    this.draft = this.editing = null;
  }

  /** A, B, C … of what was measured; annotations have none. */
  letterOf(id: number): string {
    const index = this.all.filter(({ kind }) => kind !== "text").findIndex((mark) => mark.id === id);
    return index < 0 ? "" : letter(index);
  }

  #put(next: readonly Mark[], run: string | null = null): void {
    this.history.change((marks: readonly Mark[]) => this.restore(marks), this.all, next, { run, of: this });
    this.all = next;
  }

  #made(kind: MarkKind, frame: number, points: readonly PlanePoint[]): Mark {
    return { id: ++this.#newest, kind, frame, points, text: "" };
  }
}

/** A to Z, then AA, AB … */
export function letter(index: number): string {
  const last = String.fromCharCode(65 + (index % 26));
  return index < 26 ? last : letter(Math.floor(index / 26) - 1) + last;
}

function withPoint(mark: Mark, point: number, to: PlanePoint): Mark {
  const points = mark.points.map((before, index) => (index === point ? to : before));
  if (mark.kind !== "ellipse") return { ...mark, points };
  const [a, b] = points as unknown as EllipsePoints;
  const third = point === 2 ? squareTo(a, b, to) : carried(mark.points as EllipsePoints, a, b);
  return { ...mark, points: [a, b, third] };
}

function withSecondAxis(mark: Mark): Mark {
  const [a, b] = mark.points as EllipsePoints;
  const { x_mm, z_mm } = middleOf(a, b);
  const half = SECOND_AXIS / 2;
  const third = { x_mm: x_mm - half * (b.z_mm - a.z_mm), z_mm: z_mm + half * (b.x_mm - a.x_mm) };
  return { ...mark, points: [a, b, third] };
}
