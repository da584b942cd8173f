/** One scene as it is scanned: the probe, where it is held and how its frames are shown. */

import type { Output } from "../api/outputs";
import type { Probe } from "../api/probes";
import type { StreamSettings } from "../api/stream";
import {
  between,
  IDENTITY,
  nearest,
  pivoted,
  placeOn,
  rotated,
  translated,
  type Pose,
  type Quaternion,
  type Vector,
} from "../geometry/pose";
import { History } from "./history.svelte";
import { ImageSettings } from "./image_settings.svelte";
import { KnownScene, type Held } from "./known_scene.svelte";
import { planes } from "./planes.svelte";
import { Tools } from "./tools.svelte";

/** Poses to play, of the scene's own probe. */
export interface Trajectory {
  name: string;
  poses: Pose[];
}

export class Session {
  readonly scene: KnownScene;
  #pose = $state.raw<Pose>(IDENTITY);
  /** Whether the image stands: the pose is that of the frame shown, and nothing steers the probe. */
  frozen = $state(false);
  /** How often the probe was to be steered while the image stood. */
  refusals = $state(0);
  /** How often the probe went elsewhere at once, so that a person may want to go back. */
  jumps = $state(0);
  readonly history = new History();
  readonly image = new ImageSettings();
  readonly tools = new Tools(this.history);
  /** What is played in place of the training sweep. */
  trajectory = $state.raw<Trajectory | null>(null);
  /** Where the probe was put last on the track, in its poses; between them too. */
  place = $state(0);

  readonly track = $derived.by(() => this.trajectory?.poses ?? this.scene.views);
  /** null: the scene's own. */
  #chosen = $state.raw<Held | null>(null);
  readonly #held = $derived.by(() => this.#chosen ?? this.scene.own);
  readonly chosenProbe = $derived(this.#chosen?.probe ?? null);
  readonly probe = $derived(this.#held.probe);
  readonly plane = $derived(this.#held.plane);
  /** What becomes of a pose that the probe is slid or dragged to, from where it was: in contact its face stays on the skin. */
  constrain: (before: Pose, after: Pose) => Pose = (_, after) => after;
  #placed = $state.raw<Pose | null>(null);
  /** Whether the probe is at `place`. */
  readonly onTrack = $derived(this.#pose === this.#placed);
  #choices = 0;

  constructor(readonly name: string) {
    this.scene = new KnownScene(name, () => this.#beginAnew());
  }

  /** What to ask the stream for; `plain`: without what changes the values of pixels. */
  settings(outputs: Output[], { plain = false } = {}): StreamSettings {
    const { samples, sliceThickness_mm, contact, hidesUnsupported } = this.image;
    return {
      height: samples,
      width: samples,
      probe: this.scene.description?.probe ? this.chosenProbe : this.probe,
      display: this.image.displayIn(this.plane, plain),
      outputs,
      slice_thickness_mm: sliceThickness_mm,
      min_confidence: hidesUnsupported && this.scene.description?.confidence ? 1 : null,
      below_min_confidence: "mask",
      contact,
      tools: this.tools.all.length > 0 ? [...this.tools.all] : null,
      ghost: this.tools.ghost > 0 ? this.tools.ghost : null,
      registration: null,
    };
  }

  /** Where the probe is held. Setting it steers, which is refused while the image stands. */
  get pose(): Pose {
    return this.#pose;
  }

  set pose(pose: Pose) {
    this.#steer(pose, "steering");
  }

  /** Puts the probe elsewhere at once. */
  jumpTo(pose: Pose): void {
    this.#jump(() => this.#steer(pose) && this.#put(pose));
  }

  /** Lets the image stand, at the pose of the frame that is shown. */
  freeze(pose: Pose): void {
    this.frozen = true;
    this.refusals = 0;
    this.#put(pose);
  }

  /** Takes the pose of another frame while the image stands. */
  lookAt(pose: Pose): void {
    if (this.frozen) this.#put(pose);
  }

  /** Lets the probe be steered again, from where it is unless another pose is given. */
  unfreeze(pose: Pose = this.#pose): void {
    this.frozen = false;
    if (pose !== this.#pose) this.#put(pose);
  }

  /** Slides the probe along its own axes: lateral, elevation, axial. */
  moveBy(along_mm: Vector): void {
    this.pose = this.constrain(this.pose, translated(this.pose, along_mm));
  }

  /** Turns the probe about its own axes, its face staying where it is. */
  turnBy(angles_deg: Vector): void {
    this.pose = rotated(this.pose, angles_deg, this.plane.pivot_depth_mm);
  }

  /** Gives the probe another orientation, its face staying where it is. */
  turnTo(orientation: Quaternion): void {
    this.pose = pivoted(this.pose, orientation, this.plane.pivot_depth_mm);
  }

  /** To the middle of the sweep. */
  goHome(): void {
    this.#jump(() => this.#toView(Math.floor(this.scene.views.length / 2), this.scene.home));
  }

  /** To a place of the track, in its poses. */
  goTo(place: number): void {
    this.#follow(place, "steering");
  }

  /** To the pose of the track that is nearest. */
  returnToTrack(): void {
    if (this.track.length > 0) this.goTo(nearest(this.track, this.trainedPose));
  }

  /** Takes poses to play, and goes to the first; null: the training sweep again. */
  follow(trajectory: Trajectory | null): void {
    this.trajectory = trajectory;
    if (trajectory === null) this.goHome();
    else this.#jump(() => this.#follow(0));
  }

  /** The pose that puts the face of the probe in use where that of the scene's own probe was. */
  held(view: Pose): Pose {
    return translated(view, [0, 0, this.scene.own.plane.pivot_depth_mm - this.plane.pivot_depth_mm]);
  }

  /** The pose of the scene's own probe with its face where that of the probe in use is. */
  get trainedPose(): Pose {
    return this.#trained(this.#pose);
  }

  /** To the nearest training view. */
  snap(): void {
    const index = nearest(this.scene.views, this.trainedPose);
    if (index >= 0) this.#jump(() => this.#toView(index, this.scene.views[index]!));
  }

  /** Takes another probe, its face where that of the one before was. Throws ServiceError for one that cannot be. */
  async chooseProbe(probe: Probe | null): Promise<void> {
    const choice = ++this.#choices;
    const chosen = probe && { probe, plane: await planes.get(probe) };
    if (choice !== this.#choices) return; // another one was chosen meanwhile
    const before = this.plane.pivot_depth_mm;
    this.#chosen = chosen;
    this.image.forgetDepth();
    const { onTrack } = this;
    this.#pose = translated(this.#pose, [0, 0, before - this.plane.pivot_depth_mm]);
    if (onTrack) this.#placed = this.#pose;
  }

  /** Moves the probe as a step that can be undone; false where the image stands. Changes of one `run` are one step. */
  #steer(pose: Pose, run: string | null = null): boolean {
    if (this.frozen) {
      this.refusals += 1;
      return false;
    }
    // Steps remember where the face was, which another probe does not change.
    this.history.change((trained) => this.#put(this.held(trained)), this.trainedPose, this.#trained(pose), { run });
    this.#pose = pose;
    return true;
  }

  /** Puts the probe somewhere, and finds that place on the track if it is on it. */
  #put(pose: Pose): void {
    this.#pose = pose;
    const place = placeOn(this.track, this.#trained(pose));
    if (place === null) return;
    this.place = place;
    this.#placed = pose;
  }

  #jump(move: () => unknown): void {
    const before = this.#pose;
    move();
    if (this.#pose !== before) this.jumps += 1;
  }

  /** To a training view, which is on the track unless other poses are played. */
  #toView(index: number, view: Pose): void {
    if (this.trajectory === null && this.scene.views.length > 0) this.#follow(index);
    else this.#steer(this.held(view));
  }

  /** To a place of the track. */
  #follow(place: number, run: string | null = null): void {
    const kept = Math.max(0, Math.min(this.track.length - 1, place));
    const before = this.track[Math.floor(kept)];
    const after = this.track[Math.ceil(kept)];
    if (!before || !after) return;
    const pose = this.held(between(before, after, kept % 1));
    if (!this.#steer(pose, run)) return;
    this.place = kept;
    this.#placed = pose;
  }

  /** The inverse of `held`. */
  #trained(pose: Pose): Pose {
    return translated(pose, [0, 0, this.plane.pivot_depth_mm - this.scene.own.plane.pivot_depth_mm]);
  }

  /** What was chosen for another scene of that name does not fit this one. */
  #beginAnew(): void {
    this.frozen = false;
    this.#choices += 1;
    this.#chosen = this.trajectory = null;
    this.image.beginAnew();
    this.tools.take([], 0);
    this.goHome();
    this.history.clear();
  }
}

const sessions = new Map<string, Session>();

/** The session of a scene; the same for every view. */
export function sessionOf(scene: string): Session {
  const known = sessions.get(scene);
  if (known !== undefined) return known;
  let session!: Session;
  $effect.root(() => void (session = new Session(scene))); // what it derives outlives the view that asked first
  sessions.set(scene, session);
  return session;
}

/** Lets go of what was kept about a scene that is gone. */
export function forgetSession(scene: string): void {
  sessions.delete(scene);
}
