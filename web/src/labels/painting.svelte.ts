/** Labels that a person paints on frames of a scene, and the scene that the service makes of them. */

import { explain } from "../api/client";
import type { Probe } from "../api/contract";
import { labelScene, type PaintedFrame, renderLabels } from "../api/labels";
import { deleteScene } from "../api/scenes";
import { type Frame, outputPixels } from "../api/stream";
import { isShown, pixelAt, type Placed, type PlanePoint, pointOf } from "../geometry/plane";
import type { Pose } from "../geometry/pose";
import { service } from "../page/service.svelte";
import { planes } from "../session/scene.svelte";
import { besideSession, type Session } from "../session/session.svelte";
import { words } from "../words/words.svelte";

/** Rows and columns of what is painted: shares of the depth, and of the way across the scan lines. */
export const SIDE = 256;
export const UNPAINTED = 255;
export const NO_LABEL = 0;
const MOST_LABEL = 254;

export const BRUSHES = ["brush", "region", "eraser"] as const;
type Brush = (typeof BRUSHES)[number];

const empty = (): Uint8Array => new Uint8Array(SIDE * SIDE).fill(UNPAINTED);
const isPainted = (label: number): boolean => label !== UNPAINTED;

export class Painting {
  names = $state.raw<Readonly<Record<number, string>>>({});
  chosen = $state(1);
  brush = $state<Brush>("brush");
  size_mm = $state(5);
  /** Grey levels that a region may differ from where it begins. */
  tolerance = $state(20);
  within_mm = $state(4);
  into = $state("");
  /** What is painted on; null: nothing is. */
  frame = $state.raw<Frame | null>(null);
  mask = $state.raw(empty());
  /** The labels of the scene that was made last, at the pose of the frame. */
  shown = $state.raw<Uint8Array | null>(null);
  /** What was painted on the frames before. */
  painted = $state.raw<readonly PaintedFrame[]>([]);
  /** The scene that was made. */
  made = $state<string | null>(null);
  isBusy = $state(false);
  problem = $state<string | null>(null);
  /** Of the frames; null: the scene's own. */
  #probe: Probe | null = null;
  #strokes = $state.raw<readonly Uint8Array[]>([]);
  readonly canUndo = $derived(this.#strokes.length > 0);
  readonly hasPaint = $derived(this.mask.some(isPainted));

  constructor(readonly session: Session) {
    const known = session.scene.description?.label_names ?? {};
    this.names = Object.keys(known).length > 0 ? known : { 1: words.labels.first };
    this.chosen = Number(Object.keys(this.names)[0]);
    this.into = service.freeName(session.name, "labelled");
  }

  /** Adds a label, which is then painted with. */
  add(): void {
    const label = Math.max(0, ...Object.keys(this.names).map(Number)) + 1;
    if (label > MOST_LABEL) return;
    this.names = { ...this.names, [label]: words.labels.another(label) };
    this.chosen = label;
  }

  rename(label: number, name: string): void {
    if (name.trim() !== "") this.names = { ...this.names, [label]: name.trim() };
  }

  /** Takes a frame up. */
  begin(frame: Frame): void {
    this.end();
    const { chosenProbe } = this.session;
    if (this.painted.length === 0) this.#probe = chosenProbe;
    this.problem = this.#probe === chosenProbe ? null : words.labels.otherProbe;
    if (this.problem !== null) return;
    this.frame = frame;
    void this.#show();
  }

  /** Lays the frame down; what was painted on it is kept. */
  end(): void {
    this.painted = this.#all();
    this.frame = null;
    this.#clear();
    this.shown = null;
  }

  /** Begins what one undo takes back. */
  beginStroke(): void {
    this.#strokes = [...this.#strokes, this.mask];
  }

  undo(): void {
    const before = this.#strokes.at(-1);
    if (before === undefined) return;
    this.mask = before;
    this.#strokes = this.#strokes.slice(0, -1);
  }

  /** Paints, or erases, within the brush along a line. */
  stroke(from: PlanePoint, to: PlanePoint): void {
    const points = this.#points();
    if (points === null) return;
    const mask = this.mask.slice();
    const label = this.brush === "eraser" ? UNPAINTED : this.chosen;
    const [across, down] = [to.x_mm - from.x_mm, to.z_mm - from.z_mm];
    const squared = across ** 2 + down ** 2;
    points.forEach(({ x_mm, z_mm }, cell) => {
      const [x, z] = [x_mm - from.x_mm, z_mm - from.z_mm];
      const share = squared === 0 ? 0 : Math.max(0, Math.min(1, (x * across + z * down) / squared));
      if (Math.hypot(x - share * across, z - share * down) <= this.size_mm / 2) mask[cell] = label;
    });
    this.mask = mask;
  }

  /** Paints what is as bright as a point, as far as it hangs together. */
  fill(at: PlanePoint): void {
    const [points, greys] = [this.#points(), this.#greys()];
    if (points === null || greys === null) return;
    const away = (index: number): number => Math.hypot(points[index]!.x_mm - at.x_mm, points[index]!.z_mm - at.z_mm);
    const start = points.reduce((best, _, index) => (away(index) < away(best) ? index : best), 0);
    const mask = this.mask.slice();
    const seen = new Uint8Array(mask.length);
    const waiting = [start];
    seen[start] = 1;
    for (let cell = waiting.pop(); cell !== undefined; cell = waiting.pop()) {
      mask[cell] = this.chosen;
      const column = cell % SIDE;
      for (const next of [cell - SIDE, cell + SIDE, column > 0 ? cell - 1 : -1, column < SIDE - 1 ? cell + 1 : -1])
        if (seen[next] === 0 && Math.abs(greys[next]! - greys[start]!) <= this.tolerance) {
          seen[next] = 1;
          waiting.push(next);
        }
    }
    this.mask = mask;
  }

  /** Has the service label the scene by all frames that were painted on. */
  spread(): Promise<void> {
    return this.#make(this.#all());
  }

  /** Takes back the frame that was painted on last, of those that were spread. */
  takeBack(): Promise<void> {
    return this.#make(this.painted.slice(0, -1));
  }

  async #make(frames: readonly PaintedFrame[]): Promise<void> {
    this.isBusy = true;
    this.problem = null;
    try {
      if (frames.length > 0) {
        const { names: label_names, within_mm, into, session } = this;
        const replace = into === this.made || into === session.name;
        await labelScene(session.name, { into, replace, label_names, within_mm, probe: this.#probe }, frames);
        this.made = into;
      } else if (this.made !== null) {
        await deleteScene(this.made);
        this.made = null;
      }
      this.painted = frames;
      this.#clear();
      await this.#show();
    } catch (error) {
      this.problem = explain(error);
    } finally {
      this.isBusy = false;
    }
  }

  #all(): readonly PaintedFrame[] {
    if (this.frame === null || !this.hasPaint) return this.painted;
    return [...this.painted, { pose: poseOf(this.frame), labels: this.mask, side: SIDE }];
  }

  #clear(): void {
    this.mask = empty();
    this.#strokes = [];
  }

  /** Asks for the labels at the pose of the frame. */
  async #show(): Promise<void> {
    const { frame, session } = this;
    const labelled = Object.keys(session.scene.description?.label_names ?? {}).length > 0;
    const scene = this.made ?? (labelled ? session.name : null);
    if (frame === null) return;
    try {
      const shown = scene === null ? null : await renderLabels(scene, poseOf(frame), this.#probe, SIDE);
      if (this.frame === frame) this.shown = shown;
    } catch (error) {
      this.problem = explain(error);
    }
  }

  /** The middle of each cell in the image plane. */
  #points(): readonly PlanePoint[] | null {
    const plane = this.frame && planes.of(this.frame.header.probe);
    if (plane === null) return null;
    return Array.from({ length: SIDE * SIDE }, (_, cell) =>
      pointOf(plane.lines_mm, ((cell % SIDE) + 0.5) / SIDE, (Math.floor(cell / SIDE) + 0.5) / SIDE),
    );
  }

  /** The mean grey around each cell, without which speckle would tear regions; -1e3 where the frame shows nothing. */
  #greys(): Float32Array | null {
    const { frame } = this;
    const placed: Placed | null = frame && planes.placed(frame.header);
    const values = frame && outputPixels(frame, "bmode");
    const points = this.#points();
    if (!placed || !values || points === null) return null;
    const reach = Math.max(1, Math.round(placed.height / 100));
    return Float32Array.from(points, (point) => {
      const { column, row } = pixelAt(placed, point);
      const [x, y] = [Math.round(column), Math.round(row)];
      if (x < 0 || y < 0 || x >= placed.width || y >= placed.height || !isShown(placed, x, y)) return -1e3;
      let [sum, count] = [0, 0];
      for (let j = Math.max(0, y - reach); j <= Math.min(placed.height - 1, y + reach); j++)
        for (let i = Math.max(0, x - reach); i <= Math.min(placed.width - 1, x + reach); i++, count++)
          sum += values[j * placed.width + i]!;
      return sum / count;
    });
  }
}

const poseOf = ({ header }: Frame): Pose => header.pose.flat();

/** What is painted in a session; the same each time that it is shown. */
export const paintingOf = besideSession((session) => new Painting(session));
