/** The live frames of a session: at most one a screen refresh, the newest; those of its own stream, or of another program's that is followed. */

import { settingsAgain, type StreamSettings } from "../api/contract";
import { type Frame, FrameStream, type Refusal, type StreamSummary, WatchStream } from "../api/stream";
import type { Pose } from "../geometry/pose";
import { service } from "../page/service.svelte";
import { areAlike, type Difference, differenceOf, frameSource, isLocal, LocalFrames } from "./local.svelte";
import { keyOf } from "./scene.svelte";
import type { Session } from "./session.svelte";

const KEPT = 240; // frames

export interface LatencyFigures {
  p50_ms: number;
  p99_ms: number;
  /** Since what is on the screen was asked for. */
  age_ms: number;
  /** Poses that newer ones replaced, in all. */
  dropped: number;
}

/** How long frames take, from being asked for to being on the screen. */
export class Latency {
  #times_ms: number[] = [];
  #asked_ms = 0;
  #dropped = 0;

  /** A frame that was asked for so long ago is on the screen now. */
  shown(took_ms: number, now_ms: number): void {
    this.#times_ms.push(took_ms);
    if (this.#times_ms.length > KEPT) this.#times_ms.shift();
    this.#asked_ms = now_ms - took_ms;
  }

  /** So many poses were replaced before a frame that has come. */
  dropped(poses: number): void {
    this.#dropped += poses;
  }

  /** null before the first frame. */
  figures(now_ms: number): LatencyFigures | null {
    if (this.#times_ms.length === 0) return null;
    const ordered = [...this.#times_ms].sort((a, b) => a - b);
    const at = (share: number): number => ordered[Math.min(ordered.length - 1, Math.floor(share * ordered.length))]!;
    return { p50_ms: at(0.5), p99_ms: at(0.99), age_ms: now_ms - this.#asked_ms, dropped: this.#dropped };
  }
}

export interface FollowEvents {
  /** A frame as the program got it. */
  frame(frame: Frame): void;
  /** A frame whose pixels no page can show: the same is to be rendered for the page. */
  render(pose: Pose, settings: StreamSettings): void;
  refused(refusal: Refusal): void;
  ended(): void;
}

/** Another program's stream, shown in place of the page's own: its frames, its poses, its probe. */
export class Following {
  /** Whether the connection was lost, and is tried again: what is shown is old. */
  lost = $state(false);
  /** Whether the frames are rendered for the page. */
  renderedHere = $state(false);
  /** The scene that the program asks for in place of this one. */
  otherScene = $state<string | null>(null);
  #pose: Pose | null = null;
  #choosing = false;
  #watch: WatchStream;

  constructor(
    readonly stream: StreamSummary,
    private readonly session: Session,
    private readonly events: FollowEvents,
  ) {
    this.#watch = new WatchStream(stream.id, {
      frame: (frame) => this.#take(frame),
      refused: (refusal) => this.events.refused(refusal),
      connected: (yes) => (this.lost = !yes),
      ended: () => this.events.ended(),
    });
  }

  close(): void {
    this.#watch.close();
  }

  /** Whether the probe was moved since by somebody else than the program. An image that stands moves nothing. */
  wasSteered(pose: Pose): boolean {
    if (this.session.frozen) this.#pose = null; // the first frame after that places the probe again
    return !this.#choosing && this.#pose !== null && pose !== this.#pose;
  }

  /** Puts the probe where the frame on the screen has it, unless the image stands. */
  shown({ header }: Frame): void {
    if (this.otherScene !== null || this.session.frozen) return;
    this.#place(header.pose.flat());
    if (keyOf(header.probe) === keyOf(this.session.probe) || this.#choosing) return;
    this.#choosing = true;
    const chosen = keyOf(header.probe) === keyOf(this.session.scene.own.probe) ? null : header.probe;
    void this.session
      .chooseProbe(chosen)
      .catch(() => undefined)
      .finally(() => {
        if (this.#pose !== null) this.#place(this.#pose);
        this.#choosing = false;
      });
  }

  #place(pose: Pose): void {
    this.session.pose = this.#pose = pose;
  }

  #take(frame: Frame): void {
    const { header } = frame;
    this.otherScene = header.scene === this.session.name ? null : header.scene;
    if (this.otherScene !== null) return;
    this.renderedHere = !isShowable(frame);
    if (this.renderedHere) this.events.render(header.pose.flat(), settingsAgain(header));
    else this.events.frame(frame);
  }
}

function isShowable({ header, pixels }: Frame): boolean {
  const bytes = header.height * header.width * header.outputs.length;
  return header.encoding === "uint8" && header.outputs.includes("bmode") && pixels.length >= bytes;
}

const RATES_EVERY_MS = 500;
const SCENE_ASKED_AGAIN_MS = 3000;
const COMPARED = 8; // frames that wait for those of the other source
const FAILURES_SAID = 5; // in a row; by then the state of the service is known

/** The live frames of a session: at most one a screen refresh, the newest, with the rate they come at. */
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
  /** Those that the page renders itself. */
  readonly local: LocalFrames;
  /** Whether frames come, from wherever they are wanted. */
  readonly arrives = $derived.by(() => (frameSource.chosen !== "page" && this.connected) || (frameSource.chosen !== "service" && this.local.ready));
  /** Of the page's frame and the service's, for the newest view that both have rendered. */
  difference = $state.raw<Difference | null>(null);
  #recent: Frame[] = [];
  #newest: Frame | null = null;
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
        if (this.following?.renderedHere) this.#take(frame);
        else if (this.following === null && frameSource.chosen !== "page") this.#choose(frame);
      },
      refused: (refusal) => (this.refusal = refusal),
      connected: (yes) => {
        this.connected = yes;
        this.#failures = yes ? 0 : this.#failures + 1;
      },
    });
    this.local = new LocalFrames(session.scene, (frame) => {
      if (this.following === null && frameSource.chosen !== "service") this.#choose(frame);
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
    if (this.following !== null) return;
    if (frameSource.chosen !== "page") this.#stream.ask(this.session.pose, settings);
    if (frameSource.chosen !== "service") this.local.ask(this.session.pose, settings);
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
    this.local.close();
    this.#stream.close();
    clearInterval(this.#timer);
    cancelAnimationFrame(this.#request);
  }

  /** Takes a frame of the page's own unless a newer one is there; of one view, the service's: it tells more. */
  #choose(frame: Frame): void {
    const twin = this.#recent.find((other) => isLocal(other) !== isLocal(frame) && areAlike(other, frame));
    if (twin !== undefined) this.difference = differenceOf(frame, twin);
    this.#recent = [frame, ...this.#recent.slice(0, COMPARED - 1)];
    if (!isLocal(frame)) this.local.compareFile(frame.header.scene_sha256);
    const isOlder = this.#newest !== null && askedAt_ms(frame) < askedAt_ms(this.#newest);
    if (isLocal(frame) ? isOlder || twin !== undefined : isOlder && twin !== this.#newest) return;
    this.#newest = frame;
    this.#take(frame);
  }

  #take(frame: Frame): void {
    this.#arrived = frame;
    this.#arrived_ms = performance.now();
    if (!isLocal(frame)) this.session.scene.rendered(frame.header.scene_sha256);
    if (!isLocal(frame) || frameSource.chosen === "page") this.refusal = null;
    this.#latency.dropped(frame.header.dropped); // also those of a frame that another one replaces before it is shown
    if (this.#request === 0) this.#request = requestAnimationFrame(() => this.#show());
  }

  #show(): void {
    this.#request = 0;
    if (this.#arrived === null) return;
    const { header, roundTrip_ms } = (this.frame = this.#arrived);
    this.#shown += 1;
    const cost_ms = header.queue_ms + header.render_ms + header.encode_ms;
    const took_ms = this.following === null ? roundTrip_ms : (header.age_ms ?? cost_ms);
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

function askedAt_ms({ came_ms, roundTrip_ms }: Frame): number {
  return came_ms - roundTrip_ms;
}
