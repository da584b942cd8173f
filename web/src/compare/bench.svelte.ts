/** What Compare looks at: the frame, what it is compared with and how, the pictures of it, and where they are enlarged. */

import { asking, explain, ServiceError, untilAnswered } from "../api/client";
import { type ComparedFrame, type Comparison, comparisonOf, describeScene, type Metric } from "../api/scenes";
import { router } from "../page/router.svelte";
import { service } from "../page/service.svelte";
import { METRICS } from "../shared/text";
import { type Grey, MEASURED, type Measured, metricOf, readGrey, worstFirst } from "./pictures";

/** A picture of the service that follows its address; the one before stays, told to be old, until it is there. */
export class LoadedPicture {
  picture = $state.raw<Grey | null>(null);
  problem = $state<string | null>(null);
  stale = $state(true);

  /** Follows `path`; null: there is none yet. Must be made while a component is being made; ends with it. */
  constructor(path: () => string | null) {
    const followed = $derived(path());
    $effect(() => {
      const wanted = followed;
      this.stale = true;
      if (wanted === null) return;
      return asking(
        async (signal, tell) => {
          const picture = await untilAnswered(() => readGrey(wanted, signal), tell, signal);
          if (!signal.aborted) [this.picture, this.problem, this.stale] = [picture, null, false];
        },
        (error) => ([this.picture, this.problem] = [null, explain(error)]),
      );
    });
  }
}

const MOST_ASKED = 40; // scenes

/** Asks for a comparison until it is whole, or failed; `take` gets what is known of it each time. */
async function followComparison(
  scene: string,
  take: (comparison: Comparison) => void,
  tell: (error: unknown) => void,
  signal: AbortSignal,
): Promise<void> {
  for (;;) {
    const found = await untilAnswered(() => comparisonOf(scene, signal), tell, signal);
    if (signal.aborted) return;
    take(found);
    if (found.state !== "running") return;
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
  }
}

/** Has the service compare another scene with its held-out frames, too. */
export class Rival {
  frames = $state.raw<readonly ComparedFrame[]>([]);
  problem = $state<string | null>(null);

  /** Follows `scene`; null: none. Must be made while a component is being made; ends with it. */
  constructor(scene: () => string | null) {
    $effect(() => {
      const wanted = scene();
      [this.frames, this.problem] = [[], null];
      if (wanted === null) return;
      return asking(
        (signal, tell) => followComparison(wanted, ({ frames, reason }) => ([this.frames, this.problem] = [frames, reason]), tell, signal),
        (error) => (this.problem = explain(error)),
      );
    });
  }
}

/** The names of the other scenes that were trained from the same sweep. */
export async function scenesOfSameSweep(scene: string): Promise<string[]> {
  const { dataset_sha256: sweep } = await describeScene(scene);
  const others = service.scenes.filter((one) => one.error == null && one.name !== scene).slice(0, MOST_ASKED);
  const described = await Promise.all(others.map(({ name }) => describeScene(name).catch(() => null)));
  return others.filter((_, place) => sweep !== null && described[place]?.dataset_sha256 === sweep).map(({ name }) => name);
}

export const MODES = ["side", "all", "wipe", "flicker"] as const;
export type Mode = (typeof MODES)[number];
export const ORDERS = ["sweep", "worst"] as const;
export type Order = (typeof ORDERS)[number];

/** What stands beside the truth: a measured way by its name, or the rendering of another scene. */
export type Against = { way: Measured } | { scene: string };

const POLL_MS = 700;
export const SCENE = "scene:";

/** What an address or a choice names: a scene, or else a way; what is none is the rendering. */
export function againstOf(name: string): Against {
  if (name.startsWith(SCENE)) return { scene: name.slice(SCENE.length) };
  return { way: MEASURED.find((one) => one === name) ?? "rendering" };
}

/** What Compare looks at: the frame, what it is compared with, how, and where the pictures are enlarged. */
export class Bench {
  comparison = $state.raw<Comparison | null>(null);
  problem = $state<string | null>(null);
  /** Whether the service has not the sweep of the scene. */
  withoutDataset = $state(false);
  /** Of the address; there may be fewer frames since. */
  #wanted = $state(0);
  metric = $state<Metric>("psnr_db");
  against = $state.raw<Against>({ way: "rendering" });
  /** Its name. */
  readonly other = $derived("scene" in this.against ? SCENE + this.against.scene : this.against.way);
  mode = $state<Mode>("side");
  order = $state<Order>("sweep");
  #attempts = $state(0);
  readonly frames = $derived<readonly ComparedFrame[]>(this.comparison?.frames ?? []);
  readonly index = $derived(Math.max(0, Math.min(this.frames.length - 1, this.#wanted)));
  readonly frame = $derived(this.frames[this.index]);
  /** The way whose metrics decide what is worst; another scene has the rendering's. */
  readonly way = $derived<Measured>("way" in this.against ? this.against.way : "rendering");
  /** Whether each frame has the metrics that decide it. */
  readonly isRanked = $derived(this.frames.every((frame) => metricOf(frame, this.way, this.metric) !== null));
  readonly ranked = $derived(worstFirst(this.frames, this.way, this.metric));
  /** The places of the frames, as one steps through them. */
  readonly sequence = $derived(this.order === "worst" ? this.ranked : this.frames.map((_, place) => place));
  readonly place = $derived(this.sequence.indexOf(this.index));

  /** Must be made while a component is being made; ends with it. */
  constructor(scene: string) {
    $effect(() => {
      void this.#attempts;
      return asking(
        (signal, tell) => followComparison(scene, (found) => ([this.comparison, this.problem] = [found, null]), tell, signal),
        (error) => {
          this.withoutDataset = error instanceof ServiceError && error.reason === "DATASET_NOT_FOUND";
          this.problem = explain(error);
        },
      );
    });
    $effect(() => {
      void router.arrivals;
      this.#read();
    });
  }

  tryAgain(): void {
    this.comparison = this.problem = null;
    this.withoutDataset = false;
    this.#attempts += 1;
  }

  /** To a frame, by its place among the held-out ones. */
  goTo(index: number): void {
    this.#wanted = Math.max(0, Math.min(this.frames.length - 1, index));
    this.#keep();
  }

  /** Frames on in the order that is chosen. */
  step(by: number): void {
    const place = Math.max(0, Math.min(this.sequence.length - 1, this.place + by));
    this.goTo(this.sequence[place] ?? 0);
  }

  choose(chosen: Partial<Pick<Bench, "metric" | "against" | "mode" | "order">>): void {
    Object.assign(this, chosen);
    this.#keep();
  }

  #keep(): void {
    router.keep({
      frame: this.index === 0 ? null : String(this.index),
      metric: this.metric === "psnr_db" ? null : this.metric,
      with: this.other === "rendering" ? null : this.other,
      look: this.mode === "side" ? null : this.mode,
      order: this.order === "sweep" ? null : this.order,
    });
  }

  #read(): void {
    const { frame, metric, with: other = "", look, order } = router.kept;
    const index = Number(frame ?? 0);
    this.#wanted = Number.isInteger(index) && index >= 0 ? index : 0;
    this.metric = METRICS.find((one) => one === metric) ?? "psnr_db";
    this.mode = MODES.find((one) => one === look) ?? "side";
    this.order = ORDERS.find((one) => one === order) ?? "sweep";
    this.against = againstOf(other);
  }
}
