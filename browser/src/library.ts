/** libultragray (model/library/ultragray.h), compiled to WebAssembly: what goes into its memory, and out of it, is copied. */

interface Exports {
  memory: WebAssembly.Memory;
  _initialize(): void;
  malloc(bytes: number): number;
  free(at: number): void;
  ultragray_load(bytes: number, size: number): number;
  ultragray_load_part(bytes: number, size: number): number;
  ultragray_scene_info(scene: number): number;
  ultragray_free_scene(scene: number): void;
  ultragray_prepare(scene: number, settings: number): number;
  ultragray_view_info(view: number): number;
  ultragray_frame_bytes(view: number): number;
  ultragray_free_view(view: number): void;
  ultragray_render(view: number, poses: number, count: number, threads: number, pixels: number, extrapolations: number): number;
  ultragray_problem(): number;
}

/** How much of a file is at hand. */
export type Extent = "whole" | "beginning";

const NO_FILE = 8; // WASI's "bad file descriptor": there are no files
const POSE_BYTES = 128;
const FIGURES = 5; // of ultragray_extrapolation, a double each

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

  /** The frame of a pose [4, 4], row by row, and its ultragray_extrapolation, field by field; NaN: not known. */
  render(view: number, pose: readonly number[]): { pixels: Uint8Array<ArrayBuffer>; figures: Float64Array } {
    const size = this.exports.ultragray_frame_bytes(view);
    const before = POSE_BYTES + 8 * FIGURES;
    return this.#with(new Uint8Array(before + size), (at) => {
      new Float64Array(this.exports.memory.buffer, at, 16).set(pose);
      if (this.exports.ultragray_render(view, at, 1, 1, at + before, at + POSE_BYTES) !== 0) this.#fail();
      const { buffer } = this.exports.memory;
      return {
        pixels: new Uint8Array(buffer).slice(at + before, at + before + size),
        figures: new Float64Array(buffer, at + POSE_BYTES, FIGURES).slice(),
      };
    });
  }

  /** What `act` makes of bytes that are in the memory while it runs. */
  #with<Result>(bytes: Uint8Array, act: (at: number) => Result): Result {
    const at = this.exports.malloc(bytes.length);
    if (at === 0) throw new Error("the memory does not suffice");
    try {
      new Uint8Array(this.exports.memory.buffer).set(bytes, at);
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
