/** The live frames of a session: at most one a screen refresh, the newest, with the rates they come at. */

import { FrameStream, type Frame, type Refusal, type StreamSettings } from "../api/stream";
import { service } from "../shell/service.svelte";
import type { Session } from "./session.svelte";

const RATES_EVERY_MS = 500;
const SCENE_ASKED_AGAIN_MS = 3000;
const FAILURES_SAID = 5; // in a row; by then the state of the service is known

export interface Rates {
  perSecond: number;
  roundTrip_ms: number;
  render_ms: number;
}

export class LiveView {
  frame = $state.raw<Frame | null>(null);
  connected = $state(false);
  #failures = $state(0);
  /** Whether the stream cannot be opened although the service answers. */
  readonly barred = $derived(this.#failures >= FAILURES_SAID && service.status === "ready");
  /** Why the newest pose got no frame. */
  refusal = $state.raw<Refusal | null>(null);
  rates = $state.raw<Rates>({ perSecond: 0, roundTrip_ms: 0, render_ms: 0 });
  #stream: FrameStream;
  #arrived: Frame | null = null;
  #request = 0;
  #shown = 0;
  #since_ms = performance.now();
  #timer: ReturnType<typeof setInterval>;

  /** Must be made while a component is being made; ends with it. */
  constructor(
    private readonly session: Session,
    private readonly onshow: (frame: Frame) => void = () => undefined,
  ) {
    this.#stream = new FrameStream(session.name, {
      frame: (frame) => this.#take(frame),
      refused: (refusal) => (this.refusal = refusal),
      connected: (yes) => {
        this.connected = yes;
        this.#failures = yes ? 0 : this.#failures + 1;
      },
    });
    this.#timer = setInterval(() => this.#measure(), RATES_EVERY_MS);
    // Until the scene is known as it is now, and while the stream is lost, the service is asked what is the matter.
    $effect(() => {
      if (session.known && !session.outdated && this.connected) return;
      void session.load();
      const timer = setInterval(() => void session.load(), SCENE_ASKED_AGAIN_MS);
      return () => clearInterval(timer);
    });
    $effect(() => {
      if (service.status !== "ready") return;
      this.#failures = 0;
      this.#stream.reconnect();
    });
    $effect(() => () => this.#close());
  }

  /** Asks for the frame of where the probe is now. */
  ask(settings: StreamSettings): void {
    this.#stream.ask(this.session.pose, settings);
  }

  #close(): void {
    this.#stream.close();
    clearInterval(this.#timer);
    cancelAnimationFrame(this.#request);
  }

  #take(frame: Frame): void {
    this.#arrived = frame;
    this.refusal = null;
    this.session.rendered(frame.header.scene_sha256);
    if (this.#request === 0) this.#request = requestAnimationFrame(() => this.#show());
  }

  #show(): void {
    this.#request = 0;
    if (this.#arrived === null) return;
    this.frame = this.#arrived;
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
