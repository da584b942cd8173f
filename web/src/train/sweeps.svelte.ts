/** The sweeps of the service, the one that is chosen and sent, and the crop that is drawn on it before. */

import { type Dataset, type DatasetOptions, listDatasets, uploadDataset } from "../api/datasets";
import { Listed, Sending } from "../shared/asking.svelte";
import { nameOfFile } from "../shared/text";
import { Sequence, type SequenceFrame, type Size } from "./sequence";

class Datasets extends Listed<Dataset[]> {
  /** null: not asked for yet. */
  all = $state.raw<Dataset[] | null>(null);
  /** Name of the dataset that is looked at; empty: none. */
  chosen = $state("");
  readonly dataset = $derived(this.all?.find((one) => one.name === this.chosen) ?? null);
  readonly names = $derived((this.all ?? []).map(({ name }) => name));

  protected ask(): Promise<Dataset[]> {
    return listDatasets();
  }

  protected take(found: Dataset[]): void {
    this.all = found.map((dataset) => this.#known(dataset));
    if (this.dataset === null) this.chosen = this.all[0]?.name ?? "";
  }

  /** The object that stands for the dataset already: what is shown of it is not built anew at each answer. */
  #known(dataset: Dataset): Dataset {
    const before = this.all?.find((one) => one.name === dataset.name);
    return before?.sha256 === dataset.sha256 && before.created_at === dataset.created_at ? before : dataset;
  }
}

export const datasets = new Datasets();

class SweepUpload extends Sending {
  files = $state.raw<File[]>([]);
  name = $state("");
  isPrivate = $state(false);
  options = $state<DatasetOptions>({});

  choose(files: File[]): void {
    this.files = files;
    this.problem = null;
    const named = files.find((file) => !/\.xml$/i.test(file.name)) ?? files[0];
    if (named) this.name = nameOfFile(named.name) || "sweep";
  }

  /** Lets go of the files and of what was entered for them. */
  discard(): void {
    this.files = [];
    this.options = {};
    this.isPrivate = false;
  }

  /** Sends the files; what comes of them is the dataset that is looked at. */
  async send(): Promise<void> {
    const dataset = await this.transfer((told, signal) =>
      uploadDataset(this.name, this.files, { ...this.options }, this.isPrivate, told, signal),
    );
    if (dataset === null) return;
    this.discard();
    await datasets.refresh();
    datasets.chosen = dataset.name;
  }
}

export const sweepUpload = new SweepUpload();

export interface Crop {
  left: number;
  right: number;
  top: number;
  bottom: number;
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

export type Preview = "none" | "reading" | "shown" | "unreadable";

class CropDrawing {
  state = $state<Preview>("none");
  frame = $state.raw<SequenceFrame | null>(null);
  index = $state(0);
  frames = $state(0);
  #sequence: Sequence | null = null;
  #asked = 0;

  /** The edges as they are written among the options, also outside of the image; null: no edges are written there. */
  readonly edges = $derived.by<Crop | null>(() => {
    if (this.frame === null) return null;
    const written = sweepUpload.options.crop ?? "";
    return written.trim() === "" ? whole(this.frame) : readEdges(written, this.frame);
  });
  /** null: what is written is no crop of this image. */
  readonly crop = $derived(this.frame !== null && this.edges !== null && holds(this.edges, this.frame) ? this.edges : null);

  /** Looks into files that were chosen. */
  async look(files: readonly File[]): Promise<void> {
    const asked = ++this.#asked;
    this.state = "none";
    this.frame = null;
    this.index = 0;
    if (!files.some(({ name }) => /\.(mha|mhd|nrrd|nhdr)$/i.test(name))) return;
    this.state = "reading";
    try {
      const sequence = await Sequence.among(files);
      const frame = (await sequence?.frame(0)) ?? null;
      if (asked !== this.#asked) return;
      this.#sequence = sequence;
      this.frames = sequence?.frames ?? 0;
      this.frame = frame;
      this.state = frame === null ? "unreadable" : "shown";
    } catch {
      if (asked === this.#asked) this.state = "unreadable";
    }
  }

  async show(index: number): Promise<void> {
    const asked = this.#asked;
    this.index = index;
    const frame = (await this.#sequence?.frame(index)) ?? null;
    if (asked === this.#asked && index === this.index && frame !== null) this.frame = frame;
  }

  draw(crop: Crop): void {
    sweepUpload.options.crop = writeCrop(crop);
  }

  /** Takes the whole image again. */
  clear(): void {
    sweepUpload.options.crop = "";
  }
}

export const cropDrawing = new CropDrawing();

const DEGREES = 180 / Math.PI;

export interface Calibration {
  /** Which way columns and rows of the image run: 0 to 5 are +x, +y, +z, −x, −y, −z of the probe. */
  column: number;
  row: number;
  /** Where the first pixel lies, mm along x and z (or the axis of the rows). */
  across_mm: number;
  deep_mm: number;
  /** Between columns and rows. */
  angle_deg: number;
}

/** Reads a matrix [4, 4], row by row. */
export function readCalibration(matrix: readonly number[]): Calibration {
  const column = [0, 4, 8].map((at) => matrix[at]!);
  const row = [1, 5, 9].map((at) => matrix[at]!);
  const origin = [3, 7, 11].map((at) => matrix[at]!);
  const along = (axis: readonly number[]): number => dot(origin, axis) / length(axis);
  return {
    column: directionOf(column),
    row: directionOf(row),
    across_mm: along(column),
    deep_mm: along(row),
    angle_deg: Math.acos(Math.max(-1, Math.min(1, dot(column, row) / (length(column) * length(row))))) * DEGREES,
  };
}

function directionOf(vector: readonly number[]): number {
  const axis = vector.reduce((best, value, at) => (Math.abs(value) > Math.abs(vector[best]!) ? at : best), 0);
  return axis + (vector[axis]! < 0 ? 3 : 0);
}

function dot(one: readonly number[], other: readonly number[]): number {
  return one.reduce((sum, value, at) => sum + value * other[at]!, 0);
}

function length(vector: readonly number[]): number {
  return Math.sqrt(dot(vector, vector));
}
