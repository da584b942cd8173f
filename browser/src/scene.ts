/** A scene whose frames are rendered here, or by a service: both behind `Scene`, so that a page changes by one word. */

import type { components } from "./generated/openapi.js";
import type { Pose } from "./pose.js";
import { Arrival } from "./arrival.js";
import { EXTRAPOLATION } from "./generated/interface.js";
import type { Extent } from "./library.js";
import { compiled, Thread } from "./thread.js";
import type { Drawn, Loaded, RendererChoice, RendererName } from "./worker.js";

type Schemas = components["schemas"];

/** What is rendered, as every door of the service takes it. Left out: as the scene has it. */
export type Settings = Partial<Omit<Schemas["RenderSettings"], "registration">>;
/** Of each output as shares (uint8 0 to 255, floats 0 to 1), labels as numbers. */
export type Output = string;

/** How far a frame extrapolates from what its scene was trained on, and how much to trust it; null: not known. */
export type Extrapolation = Schemas["Extrapolation"];

/** Where the pixels of a picture lie in the image plane; see Picture of the HTTP reference. */
export type Picture = Schemas["Picture"];

export interface FrameInfo {
  outputs: Output[];
  encoding: "uint8" | "float32" | "float16";
  height: number;
  width: number;
  picture: Picture;
}

const BYTES = { uint8: 1, float32: 4, float16: 2 };
/** A number from 0 on that has the 16 bits of IEEE 754. */
const widened = (bits: number): number => (bits < 1024 ? bits / 2 ** 24 : 2 ** ((bits >> 10) - 25) * (1024 + (bits & 1023)));

function numbers(bytes: Uint8Array, type: FrameInfo["encoding"]): Uint8Array | Float32Array {
  if (type === "uint8") return bytes;
  const { buffer } = bytes.slice();
  return type === "float32" ? new Float32Array(buffer) : Float32Array.from(new Uint16Array(buffer), widened);
}

/** The pixels of one pose. */
export class Frame {
  constructor(
    readonly info: FrameInfo,
    /** All outputs, one after another. */
    readonly bytes: Uint8Array<ArrayBuffer>,
    readonly extrapolation: Extrapolation,
    /** The type of labels among the bytes. */
    private readonly labelsAs: FrameInfo["encoding"] = "uint8",
    /** Of a scene that is connected with `seenAfter_ms`: how its pose was foretold. */
    readonly prediction: Schemas["Prediction"] | null = null,
  ) {}

  /** One output, [height, width] row by row. Throws for one that was not asked for. */
  pixels(output: Output = this.info.outputs[0]!): Uint8Array | Float32Array {
    const { outputs, encoding, height, width } = this.info;
    const count = height * width;
    let at = 0;
    for (const one of outputs) {
      const type = one === "labels" ? this.labelsAs : encoding;
      const part = this.bytes.subarray(at, at + BYTES[type] * count);
      at += part.length;
      if (one === output) return one === "labels" ? Uint8Array.from(numbers(part, type)) : numbers(part, type);
    }
    throw new Error(`the frame has ${outputs.join(", ")}, not ${output}`);
  }

  /** One output in grey, for a canvas. */
  imageData(output?: Output): ImageData {
    const pixels = this.pixels(output);
    const scale = pixels instanceof Float32Array ? 255 : 1;
    const image = new ImageData(this.info.width, this.info.height);
    pixels.forEach((value, at) => {
      image.data.fill(value * scale, 4 * at, 4 * at + 3);
      image.data[4 * at + 3] = 255;
    });
    return image;
  }
}

export interface Scene {
  /** What the scene says of itself: probe, size of its images, labels … */
  readonly info: SceneInfo;
  /** When frames are those of the whole file. Rejects, in a sentence, where the rest of it is damaged, does not come, or is too large for the GPU. */
  readonly whole: Promise<void>;
  /** What drew the newest frame, or will draw the first. */
  readonly renderer: RendererName | "service";
  /** How many workers of this page drew the newest frame. */
  readonly workers: number;
  /** The frame of a pose. Throws, in a sentence, for a pose or settings that cannot be. */
  render(pose: Pose, settings?: Settings): Promise<Frame>;
  close(): void;
}

/** The fields of a scene's own description that both ways of rendering tell. */
export interface SceneInfo {
  probe: Schemas["Scene"]["probe"];
  image_height: number | null;
  image_width: number | null;
  label_names: Record<string, string>;
  [name: string]: unknown;
}

const RENDERERS: RendererChoice[] = ["auto", "wasm", "webgpu"];
const MOST_VIEWS = 4; // settings that are kept ready

class LocalScene implements Scene {
  readonly whole = Promise.resolve();
  workers = 0;
  #views = new Map<string, Promise<{ view: number; info: FrameInfo }>>();
  #number = 0; // of the newest view

  constructor(
    private readonly thread: Thread,
    readonly info: SceneInfo,
    public renderer: RendererName,
  ) {}

  async render(pose: Pose, settings: Settings = {}): Promise<Frame> {
    const { view, info } = await this.#view(textOf(settings));
    const frame = await this.thread.ask<Drawn>({ act: "render", view, pose: checked(pose) });
    [this.renderer, this.workers] = [frame.renderer, frame.workers];
    const figures = Object.keys(EXTRAPOLATION).map((name, at) => [name, Number.isNaN(frame.figures[at]) ? null : frame.figures[at]]);
    return new Frame(info, frame.pixels, Object.fromEntries(figures) as Extrapolation);
  }

  close(): void {
    this.thread.close();
  }

  #view(settings: string): Promise<{ view: number; info: FrameInfo }> {
    let kept = this.#views.get(settings);
    if (kept === undefined) {
      const view = ++this.#number;
      kept = this.thread.ask<string>({ act: "prepare", view, settings }).then((info) => ({ view, info: JSON.parse(info) as FrameInfo }));
      kept.catch(() => this.#views.delete(settings)); // the next one is told again what is wrong
    }
    this.#views.delete(settings);
    this.#views.set(settings, kept); // the newest is the last
    for (const [oldest, view] of this.#views) {
      if (this.#views.size <= MOST_VIEWS) break;
      this.#views.delete(oldest);
      void view.then(({ view }) => this.thread.ask({ act: "freeView", view }));
    }
    return kept;
  }
}

/** A scene whose file still arrives: finer ones of the same take its place. */
class ArrivingScene implements Scene {
  readonly whole: Promise<void>;
  #closed = false;

  constructor(
    private now: Scene,
    arrival: Arrival,
    progress: (share: number) => void,
    private readonly drawing: Drawing,
  ) {
    this.whole = this.#refine(arrival, progress);
    this.whole.catch(() => undefined); // for those who do not ask for it
  }

  get info(): SceneInfo {
    return this.now.info;
  }

  get renderer(): Scene["renderer"] {
    return this.now.renderer;
  }

  get workers(): number {
    return this.now.workers;
  }

  async render(pose: Pose, settings?: Settings): Promise<Frame> {
    const used = this.now;
    try {
      return await used.render(pose, settings);
    } catch (error) {
      if (used === this.now) throw error;
      return this.render(pose, settings); // a finer one has taken its place
    }
  }

  close(): void {
    this.#closed = true;
    this.now.close();
  }

  async #refine(arrival: Arrival, progress: (share: number) => void): Promise<void> {
    progress(arrival.share);
    while (arrival.share < 1) {
      const finer = await opened(await arrival.next(), this.drawing);
      if (this.#closed) return finer.close();
      const coarser = this.now;
      this.now = finer;
      coarser.close();
      progress(arrival.share);
    }
  }
}

type Waiting = { asked_ms: number; resolve: (frame: Frame) => void; reject: (error: Error) => void };

const MOST_AHEAD_MS = 1000; // of predict_ms
const LATENCIES = 32; // whose median is expected of the next frame

class ServedScene implements Scene {
  readonly whole = Promise.resolve();
  readonly renderer = "service";
  readonly workers = 0;
  #socket: Promise<WebSocket> | undefined;
  #sequence = 0;
  #waiting = new Map<number, Waiting>();
  #settings = ""; // of the newest message
  #settingsSince = 0; // the first message that had these
  #drawn = 0; // the newest message that got a frame
  #latencies_ms: number[] = [];
  /** Of the newest answer: it aligns the clocks. */
  #newest: { answer_sent_ms: number; answer_arrived_ms: number } | undefined;

  constructor(
    private readonly address: URL,
    private readonly protocols: string[],
    readonly info: SceneInfo,
    private readonly seenAfter_ms?: number,
  ) {}

  async render(pose: Pose, settings: Settings = {}): Promise<Frame> {
    const [matrix, written] = [checked(pose), textOf(settings)];
    this.#socket ??= this.#open();
    const socket = await this.#socket;
    return new Promise((resolve, reject) => {
      this.#sequence += 1;
      const asked_ms = performance.now();
      this.#waiting.set(this.#sequence, { asked_ms, resolve, reject });
      if (written !== this.#settings) [this.#settings, this.#settingsSince] = [written, this.#sequence];
      const rows = [0, 4, 8, 12].map((at) => matrix.slice(at, at + 4));
      // Settings that are refused leave those before them: they are sent until a frame of them has come.
      const changed = this.#drawn >= this.#settingsSince ? {} : { settings };
      const clock = this.#newest && { ...this.#newest, sent_ms: performance.now() };
      const times = { client_time_ms: asked_ms, clock, ...this.#ahead() };
      socket.send(JSON.stringify({ sequence: this.#sequence, mode: "ordered", pose: { matrix: rows }, ...times, ...changed }));
    });
  }

  /** From now to when the frame of a pose will be seen, where frames are to be those of then. */
  #ahead(): { predict_ms?: number } {
    if (this.seenAfter_ms === undefined) return {};
    const median_ms = [...this.#latencies_ms].sort((a, b) => a - b)[this.#latencies_ms.length >> 1] ?? 0;
    return { predict_ms: Math.min(this.seenAfter_ms + median_ms, MOST_AHEAD_MS) };
  }

  close(): void {
    void this.#socket?.then((socket) => socket.close());
  }

  #open(): Promise<WebSocket> {
    return new Promise((resolve, reject) => {
      const socket = new WebSocket(this.address, this.protocols);
      socket.binaryType = "arraybuffer";
      socket.onopen = () => resolve(socket);
      socket.onmessage = ({ data }: MessageEvent<ArrayBuffer | string>) => this.#take(data);
      socket.onclose = () => {
        const lost = new Error(`the connection to ${this.address.host} ended, or could not be opened`);
        reject(lost);
        for (const { reject: refuse } of this.#waiting.values()) refuse(lost);
        this.#waiting.clear();
        this.#socket = this.#newest = undefined; // the next pose opens another
        this.#settings = "";
      };
    });
  }

  #take(data: ArrayBuffer | string): void {
    if (typeof data === "string") {
      const { sequence, error } = JSON.parse(data) as Schemas["RefusalMessage"];
      this.#settle(sequence)?.reject(new Error(error.detail));
      return;
    }
    const answer_arrived_ms = performance.now();
    const length = new DataView(data).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length))) as Schemas["FrameMessage"];
    this.#newest = { answer_sent_ms: header.sent_ms, answer_arrived_ms };
    this.#drawn = header.sequence;
    const begin = Math.ceil((4 + length) / 8) * 8;
    const waiting = this.#settle(header.sequence);
    if (waiting === undefined) return;
    this.#latencies_ms = [...this.#latencies_ms.slice(1 - LATENCIES), performance.now() - waiting.asked_ms];
    const encoding = header.encoding as FrameInfo["encoding"];
    waiting.resolve(new Frame(header as unknown as FrameInfo, new Uint8Array(data, begin), header.extrapolation, encoding, header.prediction));
  }

  #settle(sequence: number): Waiting | undefined {
    const waiting = this.#waiting.get(sequence);
    this.#waiting.delete(sequence);
    return waiting;
  }
}

function checked(pose: Pose): number[] {
  if (pose.length !== 16) throw new Error(`a pose must have 16 numbers, [4, 4] row by row, got ${pose.length}`);
  return [...pose];
}

/** The settings as JSON. Throws for numbers that JSON would leave out, and for encodings that are not pixels. */
function textOf(settings: Settings): string {
  const encoding = settings.encoding ?? "uint8";
  if (!(encoding in BYTES)) throw new Error(`encoding must be one of ${Object.keys(BYTES).join(", ")}, got ${encoding}`);
  return JSON.stringify(settings, (name, value: unknown) => {
    if (typeof value === "number" && !Number.isFinite(value)) throw new Error(`settings must hold finite numbers, got ${value} as ${name}`);
    return value;
  });
}

async function opened(part: Part | Promise<Part>, drawing: Drawing): Promise<Scene> {
  const [thread, module] = [new Thread(), compiled()]; // while the part arrives
  try {
    const [bytes, extent] = await part;
    const loaded = await thread.ask<Loaded>({ act: "load", module: await module, bytes, extent, ...drawing });
    const told = JSON.parse(loaded.info) as SceneInfo;
    told.label_names ??= {}; // a file without labels says nothing of them
    return new LocalScene(thread, told, loaded.renderer);
  } catch (error) {
    thread.close();
    throw error;
  }
}

type Part = [bytes: Uint8Array, extent: Extent];

interface Drawing {
  renderer: RendererChoice;
  workers: number;
}

export interface ConnectOptions {
  key?: string;
  seenAfter_ms?: number;
}

export interface LoadOptions extends Partial<Drawing> {
  progress?: (share: number) => void;
}

const MOST_WORKERS = 4; // unless more are asked for: each finds anew what the plane cuts

export const Scene = {
  /** A scene file, of an address or of its bytes, whose frames are rendered here. Throws, in a sentence, for what is none.
   *
   * A compressed file (.ugz) is a scene as soon as its first part is there, and becomes finer as the others arrive:
   * `progress` is then called with the share of the file that frames show.
   *
   * `renderer`: what draws, WebAssembly or WebGPU; `auto`, WebGPU where the browser has a GPU that suffices for the scene.
   * A device that is lost leaves its frames to WebAssembly.
   *
   * `workers`: how many draw one frame of WebAssembly, each with a copy of the scene; they start with the first frame of
   * more than 64 scan lines. Without it, one for each core, up to four.
   */
  async load(source: string | URL | Uint8Array, options: LoadOptions = {}): Promise<Scene> {
    const { progress = () => undefined, renderer = "auto", workers = Math.min(navigator.hardwareConcurrency, MOST_WORKERS) } = options;
    if (!RENDERERS.includes(renderer)) throw new Error(`renderer must be one of ${RENDERERS.join(", ")}, got ${renderer}`);
    if (!Number.isInteger(workers) || workers < 1) throw new Error(`workers must be a whole number of at least 1, got ${workers}`);
    const drawing = { renderer, workers };
    if (source instanceof Uint8Array) return opened([source, "whole"], drawing);
    const arriving = Arrival.of(source);
    const scene = await opened(arriving.then((arrival) => arrival.next()), drawing);
    const arrival = await arriving;
    return arrival.share < 1 ? new ArrivingScene(scene, arrival, progress, drawing) : scene;
  },

  /** A scene of a service, such as `http://localhost:8000`, whose frames are streamed.
   *
   * `seenAfter_ms`: each is that of where the probe will be so long after it comes, foretold from the poses that were
   * asked for and when; `frame.prediction` says how far ahead that is. Left out: of the poses as they are.
   */
  async connect(service: string | URL, name: string, { key, seenAfter_ms }: ConnectOptions = {}): Promise<Scene> {
    const address = new URL(`/v1/scenes/${encodeURIComponent(name)}`, service);
    const answer = await fetch(address, key === undefined ? {} : { headers: { Authorization: `Bearer ${key}` } });
    if (!answer.ok) {
      const problem = (await answer.json().catch(() => ({}))) as Partial<Schemas["Problem"]>; // a proxy answers otherwise
      throw new Error(problem.detail ?? `${address.href} answers ${answer.status} ${answer.statusText}`);
    }
    const info = (await answer.json()) as SceneInfo;
    const stream = new URL(`${address.pathname}/stream`, address);
    stream.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    return new ServedScene(stream, key === undefined ? [] : ["ultragray.v1", `ultragray.key.${base64url(key)}`], info, seenAfter_ms);
  },
};

const base64url = (text: string): string =>
  btoa(String.fromCharCode(...new TextEncoder().encode(text))).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
