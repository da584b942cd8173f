/** The live frames of a session: at most one a screen refresh, the newest, with the rate they come at. */

import { FrameStream, type Frame, type Refusal, type StreamSettings } from "../api/stream";
import type { StreamSummary } from "../api/streams";
import { service } from "../shell/service.svelte";
import { Following } from "./following.svelte";
import { Latency, type LatencyFigures } from "./latency";
import type { Session } from "./session.svelte";

const RATES_EVERY_MS = 500;
const SCENE_ASKED_AGAIN_MS = 3000;
const FAILURES_SAID = 5; // in a row; by then the state of the service is known

export class LiveView {
  frame = $state.raw<Frame | null>(null);
  connected = $state(false);
  #failures = $state(0);
  /** Whether the stream cannot be opened although the service answers. */
  readonly barred = $derived(this.#failures >= FAILURES_SAID && service.status === "ready");
  /** Why the newest pose got no frame. */
  refusal = $state.raw<Refusal | null>(null);
  framesPerSecond = $state(0);
  latency = $state.raw<LatencyFigures | null>(null);
  /** The stream of another program whose frames are shown in place of the page's own. */
  following = $state.raw<Following | null>(null);
  /** The one that was followed last, and why it is not any more. */
  unfollowed = $state.raw<{ stream: StreamSummary; why: "ended" | "steered" } | null>(null);
  #latency = new Latency();
  #stream: FrameStream;
  #arrived: Frame | null = null;
  #arrived_ms = 0;
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
      frame: (frame) => {
        if (this.following === null || this.following.renderedHere) this.#take(frame);
      },
      refused: (refusal) => (this.refusal = refusal),
      connected: (yes) => {
        this.connected = yes;
        this.#failures = yes ? 0 : this.#failures + 1;
      },
    });
    this.#timer = setInterval(() => this.#measure(), RATES_EVERY_MS);
    // Until the scene is known as it is now, and while the stream is lost, the service is asked what is the matter.
    $effect(() => {
      if (session.scene.known && !session.scene.outdated && this.connected) return;
      void session.scene.load();
      const timer = setInterval(() => void session.scene.load(), SCENE_ASKED_AGAIN_MS);
      return () => clearInterval(timer);
    });
    $effect(() => {
      if (service.status !== "ready") return;
      this.#failures = 0;
      this.#stream.reconnect();
    });
    $effect(() => {
      if (this.following?.wasSteered(session.pose)) this.unfollow("steered");
    });
    $effect(() => () => this.#close());
  }

  /** Asks for the frame of where the probe is now; not while another program's frames are shown. */
  ask(settings: StreamSettings): void {
    if (this.following === null) this.#stream.ask(this.session.pose, settings);
  }

  /** Shows the frames of another program's stream, and puts the probe where they are. */
  follow(stream: StreamSummary): void {
    this.following?.close();
    this.unfollowed = null;
    this.#latency = new Latency();
    this.following = new Following(stream, this.session, {
      frame: (frame) => this.#take(frame),
      render: (pose, settings) => this.#stream.ask(pose, settings),
      refused: (refusal) => (this.refusal = refusal),
      ended: () => this.unfollow("ended"),
    });
  }

  /** The page's own frames again; `why`: if not because the person said so. */
  unfollow(why: "ended" | "steered" | null = null): void {
    if (this.following === null) return;
    this.unfollowed = why && { stream: this.following.stream, why };
    this.following.close();
    this.following = this.refusal = null;
    this.#latency = new Latency();
  }

  #close(): void {
    this.following?.close();
    this.#stream.close();
    clearInterval(this.#timer);
    cancelAnimationFrame(this.#request);
  }

  #take(frame: Frame): void {
    this.#arrived = frame;
    this.#arrived_ms = performance.now();
    this.refusal = null;
    this.session.scene.rendered(frame.header.scene_sha256);
    this.#latency.dropped(frame.header.dropped); // also those of a frame that another one replaces before it is shown
    if (this.#request === 0) this.#request = requestAnimationFrame(() => this.#show());
  }

  #show(): void {
    this.#request = 0;
    if (this.#arrived === null) return;
    const { header, roundTrip_ms } = (this.frame = this.#arrived);
    this.#shown += 1;
    const took_ms = this.following === null ? roundTrip_ms : header.queue_ms + header.render_ms + header.encode_ms;
    this.#latency.shown(took_ms + performance.now() - this.#arrived_ms, performance.now());
    this.following?.shown(this.#arrived);
    this.onshow(this.#arrived);
    this.#arrived = null;
  }

  #measure(): void {
    const now = performance.now();
    this.latency = this.#latency.figures(now);
    this.framesPerSecond = (this.#shown * 1000) / (now - this.#since_ms);
    this.#shown = 0;
    this.#since_ms = now;
  }
}
