/** The 3D view of a scene, kept while other views are shown: how it is looked at, and what is shown of it. */

import type { Gaussians } from "../api/gaussians";
import { type SceneDescription, sceneGaussians } from "../api/scenes";
import { apply, axis, type Pose, translated, type Vector, withPosition } from "../geometry/pose";
import { keptOn, putOn } from "../geometry/skin";
import { besideSession, type Session } from "../session/session.svelte";
import { type Appearance, type ColourBy, type Cut, type Look, middleOf, USUAL, type Viewpoint } from "./appearance";
import type { Gizmo } from "./probe_handle";
import { brightestOf, type Volume } from "./volume";
import type { VolumeDelivery, VolumeOrder } from "./volume.worker";

const MOST_GAUSSIANS = 200_000; // that the service tells of
const VOLUME_BUDGET_MS = 2500;
const MOST_VOXELS = 2_500_000;
const BLOCKING = 128; // of 255: a voxel that lets less than half of the sound pass
const BLOCKING_SHARES = [0.002, 0.6]; // of the voxels; between them there is bone, or what is like it

/** Only of the scene that is shown last the Gaussians are kept. */
let shown: Room | null = null;

export class Room {
  appearance = $state.raw<Appearance>(USUAL);
  cut = $state.raw<Cut>({ across: "none", at_mm: 0 });
  gizmo = $state<Gizmo>("translate");
  /** null: the person has turned the view. */
  viewpoint = $state<Viewpoint | null>("whole");
  look: Look | null = null;
  showSweep = $state(false);
  showSkin = $state(false);
  /** Whether the face stays on the skin. */
  contact = $state(false);
  /** Whether the options are open. */
  open = $state(false);
  gaussians = $state.raw<Gaussians | null>(null);
  volume = $state.raw<Volume | null>(null);
  /** Whether the volume is still made, or made finer. */
  building = $state(false);
  /** How far the face is pressed into the skin, mm; less than 0 above it. */
  readonly pressed_mm = $derived.by(() => {
    const { pose, plane, scene } = this.session;
    return scene.skin && -scene.skin.distance(apply(pose, [0, 0, plane.pivot_depth_mm]), axis(pose, 2));
  });
  /** Between which the intensities lie that the colours stand for. */
  readonly intensities = $derived.by((): [number, number] => {
    if (this.appearance.form !== "splats") return [0, this.volume === null ? 1 : brightestOf(this.volume)];
    return this.gaussians === null ? [0, 1] : middleOf(this.gaussians.column("intensity"));
  });
  /** Whether it was decided what to show first. */
  begun = false;
  #of: SceneDescription | null = null;
  #worker: Worker | null = null;

  constructor(readonly session: Session) {
    Object.assign(this, recalled(session.name));
    addEventListener("pagehide", () => remember(session.name, this));
    session.constrain = (before, after) => this.#kept(before, after);
  }

  /** What Gaussians can be coloured by. */
  readonly colours = $derived.by((): ColourBy[] => {
    const labelled = Object.keys(this.session.scene.description?.label_names ?? {}).length > 0;
    return [...(labelled ? (["label"] as const) : []), "intensity", "transmittance", "coverage"];
  });

  change(change: Partial<Appearance>): void {
    this.appearance = { ...this.appearance, ...change };
  }

  setContact(contact: boolean): void {
    this.contact = contact;
    if (contact) this.#putOn(this.session.pose);
  }

  /** Puts the face of the probe to a place on the skin. */
  putAt(place: Vector): void {
    const { pose, plane } = this.session;
    const there = translated(withPosition(pose, place), [0, 0, -plane.pivot_depth_mm]);
    this.#putOn(there);
  }

  #putOn(pose: Pose): void {
    const { scene, plane } = this.session;
    if (scene.skin) this.session.pose = putOn(scene.skin, pose, plane.pivot_depth_mm);
  }

  /** Asks for the Gaussians of the scene, where they are not there yet, and makes the volume of them. */
  async load(): Promise<void> {
    const { description } = this.session.scene;
    if (description === null || description === this.#of) return;
    this.#of = description;
    if (shown !== this) shown?.forget();
    shown = this;
    try {
      const gaussians = await sceneGaussians(this.session.name, MOST_GAUSSIANS);
      if (this.#of !== description) return;
      this.gaussians = gaussians;
      this.#build(gaussians);
    } catch {
      if (this.#of === description) this.#of = null; // the planes and the probe are shown without them
    }
  }

  /** Lets go of what takes memory. */
  forget(): void {
    this.#worker?.terminate();
    this.#worker = this.#of = this.gaussians = this.volume = null;
    this.building = false;
  }

  #kept(before: Pose, after: Pose): Pose {
    const { scene, plane } = this.session;
    return this.contact && scene.skin ? keptOn(scene.skin, before, after, plane.pivot_depth_mm) : after;
  }

  #build({ count, total, values }: Gaussians): void {
    this.#worker?.terminate();
    const isFirst = !this.begun;
    const worker = new Worker(new URL("./volume.worker.ts", import.meta.url), { type: "module" });
    this.#worker = worker;
    this.building = true;
    worker.addEventListener("message", ({ data: { volume, isLast } }: MessageEvent<VolumeDelivery>) => {
      if (isFirst && !isLast) this.#begin(volume);
      this.volume = volume;
      if (isLast) this.#end(worker);
    });
    worker.addEventListener("error", () => this.#end(worker));
    const order: VolumeOrder = { count, total, values, budget_ms: VOLUME_BUDGET_MS, mostVoxels: MOST_VOXELS };
    worker.postMessage(order);
  }

  #end(worker: Worker): void {
    worker.terminate();
    if (worker !== this.#worker) return;
    this.#worker = null;
    this.building = false;
  }

  /** Shows first what reads as anatomy: bone, where there is some, else what is bright. */
  #begin({ voxels }: Volume): void {
    this.begun = true;
    let [filled, blocking] = [0, 0];
    for (let at = 0; at < voxels.length; at += 4) {
      if (voxels[at + 1]! > BLOCKING) filled += 1;
      if (voxels[at + 2]! > BLOCKING) blocking += 1;
    }
    const share = blocking / Math.max(1, filled);
    const hasBone = share > BLOCKING_SHARES[0]! && share < BLOCKING_SHARES[1]!;
    this.change({ colour: this.colours[0]!, ...(hasBone ? { solid: "shadow", threshold: 0.5 } : {}) });
  }
}

/** What is kept of a scene; a session that was forgotten begins anew. */
export const roomOf = besideSession((session) => new Room(session));

/** What the tab remembers of the 3D view of a scene over a reload. */
const REMEMBERED = ["appearance", "cut", "gizmo", "viewpoint", "look", "showSweep", "showSkin", "contact", "open", "begun"] as const;
type Remembered = Partial<Pick<Room, (typeof REMEMBERED)[number]>>;

/** Of another version of the console nothing is taken. */
const VERSION = 1;
const keyOf = (scene: string): string => `ultragray.space.${VERSION}.${scene}`;

function remember(scene: string, room: Room): void {
  const kept = Object.fromEntries(REMEMBERED.map((name) => [name, room[name]]));
  sessionStorage.setItem(keyOf(scene), JSON.stringify(kept));
}

function recalled(scene: string): Remembered {
  const text = sessionStorage.getItem(keyOf(scene));
  return text === null ? {} : (JSON.parse(text) as Remembered);
}
