/** The bytes of a scene file while they arrive, up to the end of one of its parts at a time. */

import type { Extent } from "./library.js";

const LENGTH_BYTES = 8;
const MOST_HEADER = 4 * 2 ** 20; // as libultragray has it

export class Arrival {
  /** Of the file, the share that was taken. */
  share = 0;
  #held = new Uint8Array(2 ** 16);
  #size = 0;
  #ends: number[] | undefined; // of the parts; undefined while the header is not there
  #taken = 0;
  readonly #reading: Promise<void>;
  #ended = false;
  #wake: () => void = () => undefined;

  private constructor(stream: ReadableStream<Uint8Array>) {
    this.#reading = this.#read(stream.getReader());
    this.#reading.catch(() => undefined); // `next` tells it
  }

  static async of(address: string | URL): Promise<Arrival> {
    const answer = await fetch(address);
    if (!answer.ok) throw new Error(`${answer.url} cannot be fetched: ${answer.status} ${answer.statusText}`);
    return new Arrival(answer.body!);
  }

  /** What has arrived once another part is there: up to its end; or all, where it is the last one, or no other comes. */
  async next(): Promise<[bytes: Uint8Array, extent: Extent]> {
    while (!this.#ended && this.#reached() === this.#taken) {
      await Promise.race([new Promise<void>((resolve) => (this.#wake = resolve)), this.#reading]);
    }
    const [reached, all] = [this.#reached(), this.#ends?.at(-1) ?? 0];
    const isPart = reached > this.#taken && reached < all;
    this.#taken = reached > this.#taken ? reached : this.#size;
    this.share = isPart ? reached / all : 1;
    return [this.#held.slice(0, this.#taken), isPart ? "beginning" : "whole"];
  }

  /** The end of the last part that is there; 0 for none. */
  #reached(): number {
    this.#ends ??= partEnds(this.#held.subarray(0, this.#size));
    return this.#ends?.filter((end) => end <= this.#size).at(-1) ?? 0;
  }

  async #read(reader: ReadableStreamDefaultReader<Uint8Array>): Promise<void> {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) break;
      if (this.#size + value.length > this.#held.length) {
        const larger = new Uint8Array(2 * (this.#size + value.length));
        larger.set(this.#held.subarray(0, this.#size));
        this.#held = larger;
      }
      this.#held.set(value, this.#size);
      this.#size += value.length;
      this.#wake();
    }
    this.#ended = true;
  }
}

/** Where the parts of a compressed scene file end; none in any other file, undefined while its header is not there. */
function partEnds(bytes: Uint8Array): number[] | undefined {
  if (bytes.length < LENGTH_BYTES) return undefined;
  const length = Number(new DataView(bytes.buffer, bytes.byteOffset).getBigUint64(0, true));
  if (length > MOST_HEADER) return [];
  const begin = LENGTH_BYTES + length;
  if (bytes.length < begin) return undefined;
  try {
    const header = JSON.parse(new TextDecoder().decode(bytes.subarray(LENGTH_BYTES, begin))) as Record<string, { data_offsets: [number, number] }>;
    const parts = Object.entries(header).filter(([name]) => name.startsWith("part."));
    return parts.map(([, { data_offsets }]) => begin + data_offsets[1]).sort((a, b) => a - b);
  } catch {
    return []; // libultragray says what is wrong
  }
}
