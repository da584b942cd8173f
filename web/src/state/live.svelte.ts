/** The live frames of a session: at most one a screen refresh, the newest, with the rates they come at. */

import { FrameStream, type Frame, type Output, type Refusal } from "../api/stream";
import type { Session } from "./session.svelte";

const RATES_EVERY_MS = 500;

export interface Rates {
  perSecond: number;
  roundTrip_ms: number;
  render_ms: number;
}

export class LiveView {
  frame = $state.raw<Frame | null>(null);
  connected = $state(false);
  /** Why the newest pose got no frame. */
  refusal = $state.raw<Refusal | null>(null);
  rates = $state.raw<Rates>({ perSecond: 0, roundTrip_ms: 0, render_ms: 0 });
  #stream: FrameStream;
  #arrived: Frame | null = null;
  #request = 0;
  #shown = 0;
  #since_ms = performance.now();
  #timer: ReturnType<typeof setInterval>;

  constructor(
    private readonly session: Session,
    private readonly onshow: (frame: Frame) => void = () => undefined,
  ) {
    this.#stream = new FrameStream(session.name, {
      frame: (frame) => this.#take(frame),
      refused: (refusal) => (this.refusal = refusal),
      connected: (yes) => (this.connected = yes),
    });
    this.#timer = setInterval(() => this.#measure(), RATES_EVERY_MS);
  }

  /** Asks for the frame of where the probe is now. */
  ask(outputs: Output[]): void {
    this.#stream.ask(this.session.pose, this.session.settings(outputs));
  }

  close(): void {
    this.#stream.close();
    clearInterval(this.#timer);
    cancelAnimationFrame(this.#request);
  }

  #take(frame: Frame): void {
    this.#arrived = frame;
    if (this.#request === 0) this.#request = requestAnimationFrame(() => this.#show());
  }

  #show(): void {
    this.#request = 0;
    if (this.#arrived === null) return;
    this.frame = this.#arrived;
    this.refusal = null;
    this.#shown += 1;
    this.onshow(this.#arrived);
    this.#arrived = null;
  }

  #measure(): void {
    const now = performance.now();
    const perSecond = (this.#shown * 1000) / (now - this.#since_ms);
    const { perSecond: before } = this.rates;
    this.#shown = 0;
    this.#since_ms = now;
    if (perSecond === 0 && before === 0) return;
    this.rates = {
      perSecond,
      roundTrip_ms: this.frame?.roundTrip_ms ?? 0,
      render_ms: this.frame?.header.render_ms ?? 0,
    };
  }
}
