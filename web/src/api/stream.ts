/** The WebSockets of the service: frames of a scene for the poses that are sent, and a stream of another program to watch. */

import { apiKey, base64url, getJson, poseBody, type Schemas } from "./client";
import type { FrameHeader, Output, StreamSettings } from "./contract";

/** Why a pose got no frame. */
export type Refusal = Schemas["RefusalMessage"]["error"];

export interface Frame {
  header: FrameHeader;
  /** uint8, one output after another, each height × width. */
  pixels: Uint8Array<ArrayBuffer>;
  /** The settings that were asked for, as JSON; of another program's frame there are none. */
  asked?: string | undefined;
  /** From asking to having it. */
  roundTrip_ms: number;
  /** When it came, by the clock of the page. */
  came_ms: number;
}

export interface StreamEvents {
  frame(frame: Frame): void;
  refused(refusal: Refusal): void;
  /** Whether frames can come. Of a stream that is lost, another is opened by itself. */
  connected(yes: boolean): void;
}

const MAX_UNANSWERED = 4; // more would only wait: the newest pose is kept here until there is room
const WINDOW = 2; // frames that may come before the page has taken one: a page that stalls finds no more old ones
const LEAST_BETWEEN_MS = 24; // 40 frames a second look smooth; more would only warm the room
const RECONNECT_MS = { first: 300, most: 3000 };
const TIMEOUT_MS = 8000; // of waiting: then the service refuses a frame that is not being rendered yet
const CONNECT_MS = 10_000;
// After so long without the answer that is due, the connection is taken for dead. A scene that is loaded, or a slow
// processor, may take longer: it is given more time after each loss.
const SILENT_MS = { first: 10_000, most: 160_000 };
const PASSING = ["QUEUE_FULL", "RATE_LIMITED", "DEADLINE_EXCEEDED", "NOT_READY"];
const AGAIN_MS = 1000; // after a refusal that may pass

/** A stream that stays open, over restarts of the service, until it is closed. */
export class FrameStream {
  #socket: WebSocket | null = null;
  #timer: ReturnType<typeof setTimeout> | undefined;
  #delay_ms = RECONNECT_MS.first;
  #closed = false;
  #sequence = 0;
  #answered = 0;
  /** The settings of each message that waits for its answer. */
  #asked = new Map<number, string>();
  #sentSettings = "";
  /** Those of the newest frame: what was not answered with one must be sent again. */
  #takenSettings = "";
  #wanted: { pose: readonly number[]; settings: StreamSettings } | null = null;
  #waiting = false;
  #later: ReturnType<typeof setTimeout> | undefined;
  #again: ReturnType<typeof setTimeout> | undefined;
  #silence: ReturnType<typeof setTimeout> | undefined;
  #silent_ms = SILENT_MS.first;
  #sent_ms = -Infinity;
  /** The newest answer that has come. */
  #newest: Frame | undefined;

  constructor(
    private readonly scene: string,
    private readonly events: StreamEvents,
  ) {
    this.#open();
  }

  /** Asks for a frame; takes the place of what was asked for and not sent yet. */
  ask(pose: readonly number[], settings: StreamSettings): void {
    this.#wanted = { pose, settings };
    this.#waiting = true;
    this.#send();
  }

  /** Connects now, where a connection that was lost would be tried again later. */
  reconnect(): void {
    if (this.#socket !== null || this.#closed) return;
    clearTimeout(this.#timer);
    this.#open();
  }

  close(): void {
    this.#closed = true;
    for (const timer of [this.#timer, this.#later, this.#again, this.#silence]) clearTimeout(timer);
    this.#socket?.close();
  }

  #open(): void {
    const address = socketAddress(`/v1/scenes/${encodeURIComponent(this.scene)}/stream`);
    address.searchParams.set("name", `console ${PAGE}`);
    const socket = new WebSocket(address, subprotocols(apiKey()));
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.#delay_ms = RECONNECT_MS.first;
      this.#sequence = this.#answered = 0;
      this.#newest = undefined;
      this.#asked.clear();
      this.#sentSettings = this.#takenSettings = "";
      this.#waiting = this.#wanted !== null;
      this.#listen();
      this.events.connected(true);
      this.#send();
    };
    socket.onmessage = (event: MessageEvent<ArrayBuffer | string>) => this.#receive(event.data);
    socket.onclose = () => this.#lose();
    this.#socket = socket;
    this.#silence = setTimeout(() => this.#lose(), CONNECT_MS);
  }

  /** Gives the socket up, and opens another after a while. */
  #lose(): void {
    if (this.#closed || this.#socket === null) return;
    // A dead connection tells of its end much later, if ever.
    this.#socket.onopen = this.#socket.onmessage = this.#socket.onclose = null;
    this.#socket.close();
    this.#socket = null;
    clearTimeout(this.#silence);
    clearTimeout(this.#again);
    this.events.connected(false);
    this.#timer = setTimeout(() => this.#open(), this.#delay_ms);
    this.#delay_ms = Math.min(this.#delay_ms * 2, RECONNECT_MS.most);
  }

  /** Waits for the next answer, if one is due. */
  #listen(): void {
    clearTimeout(this.#silence);
    if (this.#sequence === this.#answered) return;
    this.#silence = setTimeout(() => {
      this.#silent_ms = Math.min(this.#silent_ms * 2, SILENT_MS.most);
      this.#lose();
    }, this.#silent_ms);
  }

  #send(): void {
    const open = this.#socket?.readyState === WebSocket.OPEN;
    if (!open || !this.#waiting || this.#wanted === null) return;
    if (this.#sequence - this.#answered >= MAX_UNANSWERED || this.#later !== undefined) return;
    const wait = this.#sent_ms + LEAST_BETWEEN_MS - performance.now();
    if (wait > 0) {
      this.#later = setTimeout(() => {
        this.#later = undefined;
        this.#send();
      }, wait);
      return;
    }
    this.#sent_ms = performance.now();
    const { pose, settings } = this.#wanted;
    this.#waiting = false;
    const nothingDue = this.#sequence === this.#answered;
    this.#sequence += 1;
    const written = JSON.stringify(settings);
    const message: Partial<Schemas["StreamMessage"]> = {
      sequence: this.#sequence,
      mode: "latest",
      window: WINDOW,
      timeout_ms: TIMEOUT_MS,
      client_time_ms: performance.now(),
      pose: { ...poseBody(pose), position_mm: null, quaternion: null },
      ...this.#clock(),
    };
    const known = written === this.#sentSettings && written === this.#takenSettings;
    if (!known) message.settings = { ...settings, encoding: "uint8" };
    this.#sentSettings = written;
    this.#asked.set(this.#sequence, written);
    this.#socket?.send(JSON.stringify(message));
    if (nothingDue) this.#listen();
  }

  #receive(data: ArrayBuffer | string): void {
    if (this.#closed) return;
    if (typeof data === "string") {
      const { sequence, error } = JSON.parse(data) as Schemas["RefusalMessage"];
      this.#takenSettings = "";
      this.#acknowledge(sequence);
      this.#settle(sequence);
      this.events.refused(error);
      if (PASSING.includes(error.reason)) this.#askAgain();
    } else {
      const frame = decodeFrame(data);
      this.#newest = frame;
      this.#acknowledge(frame.header.sequence);
      if (frame.header.sequence < this.#answered) return; // a newer pose was refused
      this.#silent_ms = Math.max(SILENT_MS.first, 2 * frame.roundTrip_ms);
      frame.asked = this.#asked.get(frame.header.sequence);
      this.#takenSettings = frame.asked ?? "";
      this.#settle(frame.header.sequence);
      this.events.frame(frame);
    }
    this.#send();
  }

  /** Tells the service that an answer was taken: it makes no more frames than the page can show. */
  #acknowledge(sequence: number): void {
    const message: Partial<Schemas["StreamMessage"]> = { acknowledged: sequence, ...this.#clock() };
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(message));
  }

  /** What aligns the clocks of page and service. */
  #clock(): Pick<Partial<Schemas["StreamMessage"]>, "clock"> {
    if (this.#newest === undefined) return {};
    const { header, came_ms } = this.#newest;
    return { clock: { answer_sent_ms: header.sent_ms, answer_arrived_ms: came_ms, sent_ms: performance.now() } };
  }

  /** The messages up to this one need no answer any more. */
  #settle(sequence: number): void {
    this.#answered = Math.max(this.#answered, sequence);
    for (const asked of this.#asked.keys()) if (asked <= sequence) this.#asked.delete(asked);
    this.#listen();
  }

  #askAgain(): void {
    clearTimeout(this.#again);
    this.#again = setTimeout(() => {
      this.#waiting = true;
      this.#send();
    }, AGAIN_MS);
  }
}

/** Of this page, so that it does not take its own stream for somebody else's. */
export const PAGE = Math.random().toString(36).slice(2, 8);

const decoder = new TextDecoder();

/** A binary message of the stream: the length of the JSON header (uint32, little endian), the header, the pixels. */
export function decodeFrame(message: ArrayBuffer): Frame {
  const length = new DataView(message).getUint32(0, true);
  const header = JSON.parse(decoder.decode(new Uint8Array(message, 4, length))) as FrameHeader;
  const came_ms = performance.now();
  return { header, pixels: new Uint8Array(message, 4 + length), roundTrip_ms: came_ms - (header.client_time_ms ?? came_ms), came_ms };
}

/** The pixels of one output of a frame; undefined where it was not asked for. */
export function outputPixels({ header, pixels }: Frame, output: Output): Uint8Array | undefined {
  const index = header.outputs.indexOf(output);
  if (index < 0) return undefined;
  const count = header.height * header.width;
  return pixels.subarray(index * count, (index + 1) * count);
}

/** The address of a WebSocket of the service. */
export function socketAddress(path: string): URL {
  const address = new URL(path, location.href);
  address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
  return address;
}

/** How a page, which cannot set headers, tells its key. */
export function subprotocols(key: string | null): string[] {
  return key === null ? [] : ["ultragray.v1", `ultragray.key.${base64url(new TextEncoder().encode(key))}`];
}

export type StreamSummary = Schemas["StreamSummary"];

/** Each page of the console calls itself so. */
export const PAGE_NAME = "console ";

export async function listStreams(scene: string, signal: AbortSignal): Promise<StreamSummary[]> {
  return (await getJson("/v1/streams", {}, { query: { scene }, signal })).streams;
}

interface WatchEvents extends StreamEvents {
  /** The stream has ended, or is not there (any more). */
  ended(): void;
}

const ENDED_CODE = 1000;
const WATCH_AGAIN_MS = 500;
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
    if (code === ENDED_CODE || this.#tries > MOST_TRIES) {
      this.#closed = true;
      this.events.ended();
      return;
    }
    this.events.connected(false);
    this.#timer = setTimeout(() => this.#open(), WATCH_AGAIN_MS);
  }
}
