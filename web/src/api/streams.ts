/** Open streams of this service, and how one of them is watched. */

import { apiKey, getJson, type Schemas } from "./client";
import { decodeFrame, socketAddress, type Frame, type Refusal, subprotocols } from "./stream";

export type StreamSummary = Schemas["StreamSummary"];

/** Each page of the console calls itself so. */
export const PAGE_NAME = "console ";

export async function listStreams(scene: string, signal: AbortSignal): Promise<StreamSummary[]> {
  return (await getJson("/v1/streams", {}, { query: { scene }, signal })).streams;
}

export interface WatchEvents {
  frame(frame: Frame): void;
  refused(refusal: Refusal): void;
  connected(yes: boolean): void;
  /** The stream has ended, or is not there (any more). */
  ended(): void;
}

const ENDED = 1000;
const RECONNECT_MS = 500;
const MOST_TRIES = 10;

/** Watches a stream until it ends or this is closed; a connection that is lost is opened again. */
export class WatchStream {
  #socket: WebSocket | null = null;
  #timer: ReturnType<typeof setTimeout> | undefined;
  #closed = false;
  #tries = 0;

  constructor(
    private readonly id: string,
    private readonly events: WatchEvents,
  ) {
    this.#open();
  }

  close(): void {
    this.#closed = true;
    clearTimeout(this.#timer);
    this.#socket?.close();
  }

  #open(): void {
    const socket = new WebSocket(socketAddress(`/v1/streams/${encodeURIComponent(this.id)}/watch`), subprotocols(apiKey()));
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.#tries = 0;
      this.events.connected(true);
    };
    socket.onmessage = ({ data }: MessageEvent<ArrayBuffer | string>) => {
      if (this.#closed) return;
      if (typeof data === "string") this.events.refused((JSON.parse(data) as Schemas["RefusalMessage"]).error);
      else this.events.frame(decodeFrame(data));
    };
    socket.onclose = ({ code }) => this.#lose(code);
    this.#socket = socket;
  }

  #lose(code: number): void {
    if (this.#closed) return;
    this.#tries += 1;
    if (code === ENDED || this.#tries > MOST_TRIES) {
      this.#closed = true;
      this.events.ended();
      return;
    }
    this.events.connected(false);
    this.#timer = setTimeout(() => this.#open(), RECONNECT_MS);
  }
}
