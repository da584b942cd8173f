/** Sweeps on their way to the service: what their files say, where they are cropped, how they are sent, and which there are. */

import { type Dataset, type DatasetOptions, listDatasets, simulateDataset, uploadDataset } from "../api/datasets";
import { axis, dot, length, position, type Vector } from "../geometry/pose";
import { Attempt, Listed, Sending } from "../shared/asking.svelte";
import { nameOfFile } from "../shared/text";

export interface Size {
  width: number;
  height: number;
}

/** A frame in grey, brought to columns lateral and rows in depth, as the service reads it. */
export interface SequenceFrame extends Size {
  grey: Uint8Array;
}

interface Stored {
  /** Of the image as it is stored. */
  columns: number;
  rows: number;
  frames: number;
  channels: number;
  orientation: string;
  /** The bytes of the pixels, whole or to be inflated. */
  data: Blob;
  compression: CompressionFormat | null;
}

const HEADER_BYTES = 4 << 20; // transforms of some thousand frames; a longer one is read further
const MOST_HEADER_BYTES = 256 << 20;
const ENDINGS = /\.(mha|mhd|nrrd|nhdr)$/i;

/** Frames out of a PLUS or 3D Slicer sequence (MetaImage or NRRD) on the person's own disk: it is looked at before it is sent. */
export class Sequence {
  private constructor(private readonly stored: Stored) {}

  get frames(): number {
    return this.stored.frames;
  }

  /** The sequence among files that were chosen; null where there is none that can be shown. Throws Error in plain words. */
  static async among(files: readonly File[]): Promise<Sequence | null> {
    const file = files.find((one) => ENDINGS.test(one.name));
    if (file === undefined) return null;
    const stored = /\.(mha|mhd)$/i.test(file.name) ? await metaImage(file, files) : await nrrd(file, files);
    return stored === null ? null : new Sequence(stored);
  }

  /** Frame number `index`; of compressed pixels all before it are inflated. */
  async frame(index: number): Promise<SequenceFrame> {
    const { columns, rows, channels, data, compression, orientation } = this.stored;
    const length = columns * rows * channels;
    const bytes = compression === null
      ? new Uint8Array(await data.slice(index * length, (index + 1) * length).arrayBuffer())
      : await inflated(data, compression, index * length, length);
    return oriented({ width: columns, height: rows, grey: channels === 1 ? bytes : luma(bytes, channels) }, orientation);
  }
}

async function metaImage(file: File, files: readonly File[]): Promise<Stored | null> {
  const header = await headerOf(file, /^ElementDataFile\s*=\s*(.*?)\s*$/m);
  const field = (name: string): string => new RegExp(`^${name}\\s*=\\s*(.*?)\\s*$`, "m").exec(header.text)?.[1] ?? "";
  const data = dataOf(file, header.bytes, /^local$/i.test(field("ElementDataFile")) ? "" : field("ElementDataFile"), files);
  const size = sizes(field("DimSize"));
  if (data === null || size === null || field("ElementType") !== "MET_UCHAR") return null;
  return {
    ...size,
    channels: Number(field("ElementNumberOfChannels") || 1),
    orientation: field("UltrasoundImageOrientation").toUpperCase(),
    data,
    compression: /^true$/i.test(field("CompressedData")) ? "deflate" : null,
  };
}

async function nrrd(file: File, files: readonly File[]): Promise<Stored | null> {
  const header = await headerOf(file, /\r?\n\r?\n/);
  const field = (name: string): string => new RegExp(`^${name}:=?\\s*(.*?)\\s*$`, "mi").exec(header.text)?.[1] ?? "";
  const data = dataOf(file, header.bytes, field("data ?file"), files);
  const isColour = /^(vector|rgba?-color|[34]-(color|vector))/i.test(field("kinds"));
  const all = field("sizes").split(/\s+/);
  const size = sizes((isColour ? all.slice(1) : all).join(" "));
  if (data === null || size === null || !/^(uchar|unsigned char|uint8(_t)?)$/i.test(field("type"))) return null;
  return {
    ...size,
    channels: isColour ? Number(all[0]) : 1,
    orientation: field("ultrasound ?image ?orientation").toUpperCase(),
    data,
    compression: /^gz(ip)?$/i.test(field("encoding")) ? "gzip" : null,
  };
}

/** The text up to and with what matches, and its length in bytes. */
async function headerOf(file: File, end: RegExp): Promise<{ text: string; bytes: number }> {
  for (let length = HEADER_BYTES; ; length *= 4) {
    const text = new TextDecoder("latin1").decode(await file.slice(0, length).arrayBuffer()); // a character is a byte
    const match = end.exec(text);
    if (match !== null) {
      const newline = match[0].endsWith("\n") ? 0 : /^\r?\n/.exec(text.slice(match.index + match[0].length))?.[0].length ?? 0;
      const bytes = match.index + match[0].length + newline;
      return { text: text.slice(0, bytes), bytes };
    }
    if (length >= Math.min(file.size, MOST_HEADER_BYTES)) return { text: "", bytes: 0 };
  }
}

function dataOf(file: File, headerBytes: number, name: string, files: readonly File[]): Blob | null {
  return name === "" ? file.slice(headerBytes) : files.find((one) => one.name === name) ?? null;
}

function sizes(text: string): Pick<Stored, "columns" | "rows" | "frames"> | null {
  const numbers = text.split(/\s+/).map(Number);
  const kept = numbers.length === 4 && numbers[2] === 1 ? [numbers[0]!, numbers[1]!, numbers[3]!] : numbers;
  if (kept.length !== 3 || !kept.every((one) => Number.isInteger(one) && one > 0)) return null;
  const [columns, rows, frames] = kept as [number, number, number];
  return { columns, rows, frames };
}

async function inflated(data: Blob, format: CompressionFormat, from: number, length: number): Promise<Uint8Array> {
  const reader = data.stream().pipeThrough(new DecompressionStream(format)).getReader();
  const found = new Uint8Array(length);
  let at = 0;
  while (at < from + length) {
    const { done, value } = await reader.read();
    if (done) break;
    const skipped = Math.max(0, from - at);
    if (skipped < value.length) found.set(value.subarray(skipped, from + length - at), Math.max(0, at - from));
    at += value.length;
  }
  await reader.cancel();
  return found;
}

/** ITU-R BT.601, as the service. */
function luma(bytes: Uint8Array, channels: number): Uint8Array {
  return Uint8Array.from({ length: bytes.length / channels }, (_, i) => {
    const at = i * channels;
    return Math.round(0.299 * bytes[at]! + 0.587 * bytes[at + 1]! + 0.114 * bytes[at + 2]!);
  });
}

/** UltrasoundImageOrientation of PLUS: where columns and rows go; the image is brought to MF. */
function oriented(frame: SequenceFrame, orientation: string): SequenceFrame {
  const [first = "M", second = "F"] = /^([MU][FN]|[FN][MU])/.exec(orientation)?.[0] ?? "MF";
  const isTransposed = first === "F" || first === "N";
  const [lateral, depth] = isTransposed ? [second, first] : [first, second];
  const [width, height] = isTransposed ? [frame.height, frame.width] : [frame.width, frame.height];
  const grey = new Uint8Array(width * height);
  for (let row = 0; row < height; row++)
    for (let column = 0; column < width; column++) {
      const x = lateral === "U" ? width - 1 - column : column;
      const y = depth === "N" ? height - 1 - row : row;
      grey[row * width + column] = frame.grey[isTransposed ? x * frame.width + y : y * frame.width + x]!;
    }
  return { width, height, grey };
}

/** The sweeps of the service, as Train lists them, and which is looked at. */
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

/** The sweep over the built-in phantom, for who has none. It goes on when the page shows another view. */
class Simulation extends Attempt {
  async start(): Promise<void> {
    await this.run(() => simulateDataset("phantom"));
    await datasets.refresh();
  }
}

export const simulation = new Simulation();

/** The sweep that is chosen and sent in Train. */
class SweepUpload extends Sending {
  readonly view = "train";
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

/** The crop that is drawn on a frame of the sweep that was chosen, before it is sent. */
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
    if (!files.some(({ name }) => ENDINGS.test(name))) return;
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
  const [column, row, origin] = [axis(matrix, 0), axis(matrix, 1), position(matrix)];
  const along = (way: Vector): number => dot(origin, way) / length(way);
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
