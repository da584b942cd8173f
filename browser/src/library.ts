/** libultragray (model/library/ultragray.h), compiled to WebAssembly: what goes into its memory, and out of it, is copied. */

import { EXTRAPOLATION, PLAN, type Functions } from "./generated/interface.js";

interface Exports extends Functions {
  memory: WebAssembly.Memory;
  _initialize(): void;
  malloc(bytes: number): number;
  free(at: number): void;
}

/** How much of a file is at hand. */
export type Extent = "whole" | "beginning";

/** A frame, and its ultragray_extrapolation, field by field; NaN: not known. */
export interface Rendered {
  pixels: Uint8Array<ArrayBuffer>;
  figures: Float64Array;
}

/** The Gaussians of a scene: see ultragray_gaussians. The arrays are there until the memory grows. */
export interface Gaussians {
  count: number;
  degree: number;
  sigmoid: boolean;
  gaussians: Float32Array<ArrayBuffer>; // [count, 12]
  harmonics: Float32Array<ArrayBuffer>; // [count, (degree + 1)^2]
}

/** ultragray_plan: what the planes of a pose are drawn by. */
export type Plan = { [Field in keyof typeof PLAN]: (typeof PLAN)[Field] extends 1 ? number : number[] };

/** Whether B-mode, echo, transmittance and coverage are wanted. */
export const wantedPlanes = ({ bmode, echo, transmittance, coverage }: Plan): boolean[] => [bmode, echo, transmittance, coverage].map(Boolean);

/** Some scan lines of the planes of a pose, from `first` to before `end`, and how many numbers that are. */
export interface Lines {
  first: number;
  end: number;
  floats: number;
}

const NO_FILE = 8; // WASI's "bad file descriptor": there are no files
const POSE_BYTES = 128;
const FIGURES = Object.keys(EXTRAPOLATION).length; // a double each
const PLAN_NUMBERS = Object.values(PLAN).reduce<number>((sum, count) => sum + count, 0);

/** One instance of the module, with a memory of its own. Whatever is wrong with an input is an Error, in a sentence. */
export class Library {
  private constructor(private readonly exports: Exports) {}

  static async of(module: WebAssembly.Module): Promise<Library> {
    const ended = (): never => {
      throw new Error("the renderer ended");
    };
    const { exports } = await WebAssembly.instantiate(module, {
      env: { emscripten_notify_memory_growth: () => undefined },
      wasi_snapshot_preview1: { proc_exit: ended, fd_close: () => NO_FILE, fd_write: () => NO_FILE, fd_seek: () => NO_FILE },
    });
    const library = new Library(exports as unknown as Exports);
    library.exports._initialize();
    return library;
  }

  /** A scene of the bytes of a scene file, or of the beginning of a compressed one, and what it says of itself. */
  load(bytes: Uint8Array, extent: Extent): { scene: number; info: string } {
    const read = extent === "whole" ? this.exports.ultragray_load : this.exports.ultragray_load_part;
    const scene = this.#with(bytes, (at) => read(at, bytes.length));
    if (scene === 0) this.#fail();
    return { scene, info: this.#text(this.exports.ultragray_scene_info(scene)) };
  }

  freeScene(scene: number): void {
    this.exports.ultragray_free_scene(scene);
  }

  /** Settings of frames (JSON), ready to render by, and what their frames are. */
  prepare(scene: number, settings: string): { view: number; info: string } {
    const text = new TextEncoder().encode(`${settings}\0`);
    const view = this.#with(text, (at) => this.exports.ultragray_prepare(scene, at));
    if (view === 0) this.#fail();
    return { view, info: this.#text(this.exports.ultragray_view_info(view)) };
  }

  freeView(view: number): void {
    this.exports.ultragray_free_view(view);
  }

  /** The frame of a pose [4, 4], row by row. */
  render(view: number, pose: readonly number[]): Rendered {
    return this.#frame(view, pose, 0, (at, figures, pixels) => this.exports.ultragray_render(view, at, 1, 1, pixels, figures));
  }

  gaussians(scene: number): Gaussians {
    const info = JSON.parse(this.#text(this.exports.ultragray_scene_info(scene))) as { sh_degree?: number; intensity?: string };
    const degree = info.sh_degree ?? 0;
    const [at, count] = this.#room(4, (count) => {
      const at = this.exports.ultragray_gaussians(scene, count);
      return [at, new Uint32Array(this.exports.memory.buffer, count, 1)[0]!];
    });
    const floats = (at: number, length: number): Float32Array<ArrayBuffer> => new Float32Array(this.exports.memory.buffer as ArrayBuffer, at, length);
    return {
      count,
      degree,
      sigmoid: info.intensity === "sigmoid",
      gaussians: floats(at, 12 * count),
      harmonics: floats(this.exports.ultragray_harmonics(scene), (degree + 1) ** 2 * count),
    };
  }

  plan(view: number, pose: readonly number[]): Plan {
    return this.#posed(pose, 8 * PLAN_NUMBERS, (at, plan) => {
      if (this.exports.ultragray_plan_of(view, at, plan) !== 0) this.#fail();
      const numbers = [...new Float64Array(this.exports.memory.buffer, plan, PLAN_NUMBERS)];
      const fields = Object.entries(PLAN).map(([field, count]) => [field, count === 1 ? numbers.shift() : numbers.splice(0, count)]);
      return Object.fromEntries(fields) as Plan;
    });
  }

  /** [H, end - first] of each plane that the plan wants, one after another. */
  draw(view: number, pose: readonly number[], { first, end, floats }: Lines): Float32Array<ArrayBuffer> {
    return this.#posed(pose, 4 * floats, (at, planes) => {
      if (this.exports.ultragray_draw(view, at, first, end, planes) !== 0) this.#fail();
      return new Float32Array(this.exports.memory.buffer as ArrayBuffer, planes, floats).slice();
    });
  }

  /** The frame of a pose whose planes, [H, W] one after another, were drawn by its plan. */
  finish(view: number, pose: readonly number[], planes: Float32Array): Rendered {
    return this.#frame(view, pose, planes.byteLength, (at, figures, pixels) => {
      const drawn = figures + 8 * FIGURES;
      new Float32Array(this.exports.memory.buffer, drawn, planes.length).set(planes);
      return this.exports.ultragray_finish(view, at, drawn, 1, pixels, figures);
    });
  }

  /** A frame that `draw` writes into the memory; the pose, figures, room for so many bytes and pixels follow each other. */
  #frame(view: number, pose: readonly number[], bytes: number, draw: (pose: number, figures: number, pixels: number) => number): Rendered {
    const size = this.exports.ultragray_frame_bytes(view);
    return this.#posed(pose, 8 * FIGURES + bytes + size, (at, figures) => {
      const pixels = figures + 8 * FIGURES + bytes;
      if (draw(at, figures, pixels) !== 0) this.#fail();
      const { buffer } = this.exports.memory;
      return { pixels: new Uint8Array(buffer).slice(pixels, pixels + size), figures: new Float64Array(buffer, figures, FIGURES).slice() };
    });
  }

  /** What `act` makes of bytes that are in the memory while it runs. */
  #with<Result>(bytes: Uint8Array, act: (at: number) => Result): Result {
    return this.#room(bytes.length, (at) => {
      new Uint8Array(this.exports.memory.buffer).set(bytes, at);
      return act(at);
    });
  }

  /** What `act` makes of a pose that is in the memory, and of room for so many bytes, while it runs. */
  #posed<Result>(pose: readonly number[], bytes: number, act: (pose: number, room: number) => Result): Result {
    return this.#room(POSE_BYTES + bytes, (at) => {
      new Float64Array(this.exports.memory.buffer, at, 16).set(pose);
      return act(at, at + POSE_BYTES);
    });
  }

  #room<Result>(bytes: number, act: (at: number) => Result): Result {
    const at = this.exports.malloc(bytes);
    if (at === 0) throw new Error("the memory does not suffice");
    try {
      return act(at);
    } finally {
      this.exports.free(at);
    }
  }

  #text(at: number): string {
    const memory = new Uint8Array(this.exports.memory.buffer);
    return new TextDecoder().decode(memory.subarray(at, memory.indexOf(0, at)));
  }

  #fail(): never {
    throw new Error(this.#text(this.exports.ultragray_problem()));
  }
}
