/** When the 3D view is drawn, and how finely: at once for the person, within a share of the time for the live image. */

const BUSY_SHARE = 0.3; // of the time, at most, goes into drawing what the live image changes: it comes first itself
const SOFTWARE_SHARE = 0.15; // where the processor draws
const HANDLED_SHARE = 0.8; // while the person turns the view or drags
const STILL_MS = 250; // after the last change it is drawn finely
const BUDGET_MS = { card: 25, software: 40 }; // of one drawing: a click waits for it, and so does the live image
const SCALES = [0.2, 0.3, 0.4, 0.55, 0.75, 1]; // of the pixels, each way
const FIRST_GUESS_MS = { card: 8, software: 250 }; // of the cloud at full size
const TRUST = 0.5; // in the newest measurement

export type Cause = "person" | "frame";

export class DrawingLoop {
  #request = 0;
  #fence: WebGLSync | null = null;
  #dirty: Cause | null = null;
  /** Of the fine picture, how many bands are drawn; null: all of them. */
  #band: number | null = 0;
  #bands = 1;
  #touched_ms = 0;
  #started_ms = 0;
  #taken_ms = 0;
  #scale = 1;
  /** Of the cloud at full size, as measured. */
  #cost_ms: number;
  #measures = false;
  readonly #kind: "card" | "software";
  /** Whether the person turns the view, or drags the probe. */
  handled = false;

  /** `draw`: draws at a scale of the pixels; true where that says what the cloud costs.
   *
   * `refine`: draws one of so many bands of the fine picture, and shows it with the last; false: nothing is to be refined.
   */
  constructor(
    private readonly context: WebGL2RenderingContext,
    readonly software: boolean,
    private readonly draw: (scale: number) => boolean,
    private readonly refine: (band: number, bands: number) => boolean,
  ) {
    this.#kind = software ? "software" : "card";
    this.#cost_ms = FIRST_GUESS_MS[this.#kind];
  }

  /** Something changed: what the person did is shown at once. */
  touch(cause: Cause): void {
    if (this.#dirty !== "person") this.#dirty = cause;
    this.#touched_ms = performance.now();
    this.#band = 0;
    this.#ask();
  }

  /** What is drawn costs something else from now on. */
  forgetCost(): void {
    this.#cost_ms = FIRST_GUESS_MS[this.#kind];
  }

  /** A fence of a context that was lost would never be signalled. */
  restart(): void {
    this.#fence = null;
    this.touch("person");
  }

  stop(): void {
    cancelAnimationFrame(this.#request);
  }

  #ask(): void {
    if (this.#request === 0) this.#request = requestAnimationFrame(this.#tick);
  }

  #tick = (): void => {
    this.#request = 0;
    if (this.#fence !== null && !this.#finished(this.#fence)) return this.#ask();
    const now = performance.now();
    if (this.#dirty !== null) {
      const after_ms = this.#taken_ms / this.#share(this.#dirty);
      if (now < this.#started_ms + after_ms) return this.#ask();
      this.#drawNow();
    } else if (this.#band !== null) {
      if (now < this.#touched_ms + STILL_MS || this.handled) return this.#ask();
      this.#refineNow(this.#band);
    }
  };

  #drawNow(): void {
    this.#scale = SCALES.findLast((scale) => this.#cost_ms * scale ** 2 <= BUDGET_MS[this.#kind]) ?? SCALES[0]!;
    this.#dirty = null;
    this.#started_ms = performance.now();
    this.#measures = this.draw(this.#scale);
    this.#await();
  }

  /** The next band, so narrow that a click need not wait long. */
  #refineNow(band: number): void {
    if (band === 0) this.#bands = Math.max(1, Math.ceil(this.#cost_ms / BUDGET_MS[this.#kind]));
    this.#started_ms = performance.now();
    this.#measures = false;
    const goesOn = this.refine(band, this.#bands);
    this.#band = goesOn && band < this.#bands - 1 ? band + 1 : null;
    if (goesOn) this.#await();
  }

  #await(): void {
    this.#fence = this.context.fenceSync(this.context.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.context.flush();
    this.#ask();
  }

  #share(cause: Cause): number {
    if (cause === "person") return this.handled ? HANDLED_SHARE : 1;
    return this.software ? SOFTWARE_SHARE : BUSY_SHARE;
  }

  #finished(fence: WebGLSync): boolean {
    if (this.context.getSyncParameter(fence, this.context.SYNC_STATUS) !== this.context.SIGNALED) return false;
    this.context.deleteSync(fence);
    this.#fence = null;
    this.#taken_ms = performance.now() - this.#started_ms;
    if (this.#measures) this.#cost_ms += TRUST * (this.#taken_ms / this.#scale ** 2 - this.#cost_ms);
    return true;
  }
}

/** Whether the processor draws, for want of a graphics card. */
export function drawnBySoftware(): boolean {
  const context = document.createElement("canvas").getContext("webgl2");
  const information = context?.getExtension("WEBGL_debug_renderer_info");
  const name = information ? String(context?.getParameter(information.UNMASKED_RENDERER_WEBGL)) : "";
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}
