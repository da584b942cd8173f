/** Frames that the page renders itself, by the service's renderer in WebAssembly: at once, and without the service once they have begun. */

import { explain, request } from "../api/client";
import type { FrameHeader, StreamSettings } from "../api/contract";
import { sceneFilePath } from "../api/scenes";
import { type Frame, outputPixels } from "../api/stream";
import type { Pose } from "../geometry/pose";
import { words } from "../words/words.svelte";
import type { KnownScene } from "./scene.svelte";

export const FRAME_SOURCES = ["service", "page", "both"] as const;
export type FrameSource = (typeof FRAME_SOURCES)[number];

const STORAGE = "ultragray.frames";
const PACKAGE = "/package/index.js"; // @ultragray/web, as the service hands it out
const MOST_BYTES = 512e6; // of a scene file: the renderer has 4 GiB of memory at most
const PAGE = "page"; // in place of a kind of renderer in the header of a frame

/** What is used of the package. */
interface PackageScene {
  render(pose: Pose, settings: object): Promise<{
    info: Pick<FrameHeader, "outputs" | "encoding" | "height" | "width" | "picture">;
    bytes: Uint8Array<ArrayBuffer>;
    extrapolation: FrameHeader["extrapolation"];
  }>;
  close(): void;
}

/** Where frames come from, as the browser remembers it. */
class Preference {
  #chosen = $state<FrameSource>(FRAME_SOURCES.find((one) => one === localStorage.getItem(STORAGE)) ?? "service");

  get chosen(): FrameSource {
    return this.#chosen;
  }

  set chosen(source: FrameSource) {
    this.#chosen = source;
    localStorage.setItem(STORAGE, source);
    if (source === "service") letGo();
  }
}

export const frameSource = new Preference();

type Opened = { scene: PackageScene; sha256: string };

/** The scene that was opened last: it stays while other views are shown, and while the service is away. */
let kept: { name: string; opened: Promise<Opened> } | null = null;

function letGo(): void {
  void kept?.opened.then(({ scene }) => scene.close()).catch(() => undefined);
  kept = null;
}

function openedOf(scene: KnownScene): Promise<Opened> {
  if (kept?.name === scene.name) return kept.opened;
  letGo();
  const opening = (kept = { name: scene.name, opened: open(scene) });
  opening.opened.catch(() => kept === opening && (kept = null)); // the next pose tries again
  return opening.opened;
}

async function open({ name, description }: KnownScene): Promise<Opened> {
  const bytes = description?.file_bytes ?? 0;
  if (bytes > MOST_BYTES) throw new Error(words.session.local.tooLarge((bytes / 1e6).toFixed(0), (MOST_BYTES / 1e6).toFixed(0)));
  const { Scene } = (await import(/* @vite-ignore */ PACKAGE).catch(() => {
    throw new Error(words.session.local.notBuilt);
  })) as { Scene: { load(bytes: Uint8Array): Promise<PackageScene> } };
  const file = new Uint8Array(await (await request(sceneFilePath(name))).arrayBuffer());
  // Browsers compute digests only for pages that they trust: not over plain HTTP from another machine.
  const digest = new Uint8Array((await crypto.subtle?.digest("SHA-256", file)) ?? []);
  const sha256 = [...digest].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  return { scene: await Scene.load(file), sha256 };
}

/** Renders the newest pose that was asked for, and after it none that was overtaken. */
export class LocalFrames {
  /** Why the newest pose got no frame. */
  problem = $state<string | null>(null);
  /** Whether frames come. */
  ready = $state(false);
  #wanted: { pose: Pose; settings: StreamSettings } | null = null;
  #isBusy = false;

  constructor(
    private readonly scene: KnownScene,
    private readonly take: (frame: Frame) => void,
  ) {}

  ask(pose: Pose, settings: StreamSettings): void {
    this.#wanted = { pose, settings };
    if (!this.#isBusy) void this.#renderAll();
  }

  close(): void {
    this.#wanted = null;
  }

  /** Lets a scene go that the service has another file of. */
  compareFile(sha256: string): void {
    if (!this.ready) return;
    void openedOf(this.scene).then((opened) => opened.sha256 !== "" && opened.sha256 !== sha256 && letGo());
  }

  async #renderAll(): Promise<void> {
    this.#isBusy = true;
    while (this.#wanted !== null) {
      const { pose, settings } = this.#wanted;
      this.#wanted = null;
      try {
        const { scene, sha256 } = await openedOf(this.scene);
        const begun_ms = performance.now();
        const { info, bytes, extrapolation } = await scene.render(pose, settings);
        const came_ms = performance.now();
        const header = { ...this.#told(settings), ...info, extrapolation, scene_sha256: sha256, pose: rowsOf(pose), render_ms: came_ms - begun_ms } as FrameHeader;
        this.take({ header, pixels: bytes, asked: JSON.stringify(settings), roundTrip_ms: came_ms - begun_ms, came_ms });
        this.problem = null;
        this.ready = true;
      } catch (error) {
        this.problem = explain(error);
        this.ready = false;
      }
    }
    this.#isBusy = false;
  }

  /** What the service would tell of a frame with such settings. */
  #told(settings: StreamSettings) {
    const { name, description, own } = this.scene;
    const { breathing: _, ...asked } = settings; // of which a frame tells the phase
    return {
      ...asked,
      probe: settings.probe ?? own.probe,
      slice_thickness_mm: settings.slice_thickness_mm ?? description?.beam?.thickness_mm ?? 0,
      rendered_height: settings.height ?? description?.image_height ?? 0,
      rendered_width: settings.width ?? description?.image_width ?? 0,
      tools: settings.tools ?? [],
      phase: settings.phase ?? [],
      scene: name,
      renderer: PAGE,
      sequence: 0,
      client_time_ms: null,
      dropped: 0,
      queue_ms: 0,
      encode_ms: 0,
    };
  }
}

function rowsOf(pose: Pose): number[][] {
  return [0, 4, 8, 12].map((at) => pose.slice(at, at + 4));
}

export const isLocal = ({ header }: Frame): boolean => header.renderer === PAGE;

/** Whether two frames show one pose by one setting. */
export function areAlike(one: Frame, other: Frame): boolean {
  const there = other.header.pose.flat();
  return one.asked === other.asked && one.header.pose.flat().every((value, at) => Math.abs(value - there[at]!) < 1e-9);
}

/** By how many of 255 grey levels two frames of one view differ. */
export interface Difference {
  largest: number;
  mean: number;
}

export function differenceOf(one: Frame, other: Frame): Difference | null {
  const [here, there] = [outputPixels(one, "bmode"), outputPixels(other, "bmode")];
  if (here === undefined || here.length !== there?.length) return null;
  const apart = here.map((value, at) => Math.abs(value - there[at]!));
  return { largest: apart.reduce((most, one) => Math.max(most, one), 0), mean: apart.reduce((sum, one) => sum + one, 0) / apart.length };
}
