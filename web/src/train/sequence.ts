/** Frames out of a PLUS or 3D Slicer sequence (MetaImage or NRRD) on the person's own disk: it is looked at before it is sent. */

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
