/** One scene as it is scanned: the probe, where it is held, how its frames are shown, which tools are in them, and what can be undone. */

import {
  AS_RENDERED, AS_TRAINED, type Display, type ImagePlane, MOST_TOOLS, type Output,
  type PlainSettings, type Probe, type StreamSettings, type Tool,
} from "../api/contract";
import { squarePixel_mm } from "../geometry/plane";
import {
  between, IDENTITY, nearest, pivoted, placeOn, type Pose, type Quaternion, rotated, translated, type Vector,
} from "../geometry/pose";
import { service } from "../page/service.svelte";
import { type Held, KnownScene, planes } from "./scene.svelte";

const MOST = 200;
const PAUSE_MS = 500; // what goes on without a longer pause is one step

interface Step {
  undo(): void;
  redo(): void;
  /** What it belongs to, and is forgotten with. */
  of?: object | undefined;
}

/** A value that went from one to another. */
class Change<T> implements Step {
  constructor(
    private readonly put: (value: T) => void,
    private readonly before: T,
    private after: T,
    readonly of?: object,
  ) {}
  undo(): void {
    this.put(this.before);
  }
  redo(): void {
    this.put(this.after);
  }
  /** Goes on to a further value. */
  extend(after: unknown): void {
    this.after = after as T;
  }
}

/** What can be undone and done again, in the order in which it was done. */
export class History {
  #done = $state.raw<readonly Step[]>([]);
  #undone = $state.raw<readonly Step[]>([]);
  readonly canUndo = $derived(this.#done.length > 0);
  readonly canRedo = $derived(this.#undone.length > 0);
  /** What may still go on: its name, its step, and when it went on last. */
  #open: { run: string; step: Change<unknown>; at_ms: number } | null = null;

  add(step: Step): void {
    this.#done = [...this.#done, step].slice(-MOST);
    this.#undone = [];
    this.#open = null;
  }

  /** Adds a change of a value. Changes of the same `run` without a pause between them are one step. */
  change<T>(put: (value: T) => void, before: T, after: T, { run = null, of }: { run?: string | null; of?: object } = {}): void {
    const now_ms = performance.now();
    if (run !== null && this.#open?.run === run && now_ms - this.#open.at_ms < PAUSE_MS) {
      this.#open.step.extend(after);
      this.#open.at_ms = now_ms;
      return;
    }
    const step = new Change(put, before, after, of);
    this.add(step);
    if (run !== null) this.#open = { run, step: step as Change<unknown>, at_ms: now_ms };
  }

  undo(): void {
    const step = this.#done.at(-1);
    if (step === undefined) return;
    this.#done = this.#done.slice(0, -1);
    this.#undone = [...this.#undone, step];
    this.#open = null;
    step.undo();
  }

  redo(): void {
    const step = this.#undone.at(-1);
    if (step === undefined) return;
    this.#undone = this.#undone.slice(0, -1);
    this.#done = [...this.#done, step];
    this.#open = null;
    step.redo();
  }

  /** Forgets the steps that belong to something. */
  forget(of: object): void {
    this.#done = this.#done.filter((step) => step.of !== of);
    this.#undone = this.#undone.filter((step) => step.of !== of);
    this.#open = null;
  }

  clear(): void {
    this.#done = this.#undone = [];
    this.#open = null;
  }
}

/** Depth samples and scan lines that are offered, beside those of the training. */
export const SIZES = [128, 256, 384, 512, 768];
const MOST_PICTURE_PIXELS = 640; // on the longer side of a scan-converted fan

/** How the frames of a scene are shown, whatever the probe. */
export class ImageSettings {
  /** How frames are shown, but for the scan conversion. */
  display = $state.raw<Display>(AS_RENDERED);
  scanConverted = $state(true);
  /** Depth samples and scan lines; null: as trained. */
  samples = $state<number | null>(null);
  /** What else is set, by the names of the contract. */
  plain = $state.raw<PlainSettings>(AS_TRAINED);
  /** Whether what no Gaussians support is black. */
  hidesUnsupported = $state(false);

  /** The display as the stream takes it, of images in that plane; `plain`: without what changes the values of pixels. */
  displayIn(plane: ImagePlane, plain: boolean): Display {
    const { depth_mm, flip } = this.display;
    return {
      ...(plain ? { ...AS_RENDERED, depth_mm, flip } : this.display),
      pixel_mm: this.scanConverted ? squarePixel_mm(plane.lines_mm, MOST_PICTURE_PIXELS) : null,
    };
  }

  set(change: Partial<PlainSettings>): void {
    this.plain = { ...this.plain, ...change };
  }

  /** Takes back what the display panel sets, but for the number of samples; ghosts are set beside the tools. */
  reset(): void {
    this.display = AS_RENDERED;
    this.plain = { ...AS_TRAINED, ghost: this.plain.ghost };
  }

  /** What fits any probe is kept, the depth of another one is not. */
  forgetDepth(): void {
    this.display = { ...this.display, depth_mm: null };
  }

  /** What was chosen for another scene does not fit this one. */
  beginAnew(): void {
    this.samples = null;
    this.plain = AS_TRAINED;
    this.forgetDepth();
  }
}

/** Things of a session, and which of them is worked on; their changes are steps that can be undone. */
export class WorkList<T> {
  all = $state.raw<readonly T[]>([]);
  #chosen = $state(0);
  readonly chosen = $derived.by(() => Math.min(this.#chosen, this.all.length - 1));
  readonly current = $derived.by<T | null>(() => this.all[this.chosen] ?? null);
  readonly isFull = $derived.by(() => this.all.length >= this.most);

  constructor(
    private readonly history: History,
    private readonly what: string,
    private readonly most: number,
  ) {}

  choose(index: number): void {
    this.#chosen = index;
  }

  /** Adds one, which is then worked on. */
  add(one: T): void {
    this.#change([...this.all, one]);
    this.#chosen = this.all.length - 1;
  }

  /** Puts a changed one in the place of that which is worked on. */
  change(changed: T): void {
    this.#put(changed, `${this.what} ${this.chosen}`);
  }

  /** `change`, as a step of its own. */
  changeInOneStep(changed: T): void {
    this.#put(changed, null);
  }

  remove(index: number): void {
    const before = this.chosen;
    this.#change(this.all.filter((_, other) => other !== index));
    if (index < before) this.#chosen = before - 1;
  }

  /** Takes all of them from elsewhere; not a step that can be undone. */
  take(all: readonly T[]): void {
    this.all = all;
    this.#chosen = 0;
  }

  #put(changed: T, run: string | null): void {
    this.#change(this.all.map((before, index) => (index === this.chosen ? changed : before)), run);
  }

  /** Changes of one `run` are one step. */
  #change(all: readonly T[], run: string | null = null): void {
    this.history.change((put) => (this.all = put), this.all, all, { run });
    this.all = all;
  }
}

/** Poses to play, of the scene's own probe. */
export interface Trajectory {
  name: string;
  poses: Pose[];
}

/** One scene as it is scanned: the probe, where it is held and how its frames are shown. */
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
  readonly tools = new WorkList<Tool>(this.history, "tool", MOST_TOOLS);
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
    const { samples, plain: others, hidesUnsupported } = this.image;
    return {
      ...others,
      height: samples,
      width: samples,
      probe: this.scene.description?.probe ? this.chosenProbe : this.probe,
      display: this.image.displayIn(this.plane, plain),
      outputs,
      min_confidence: hidesUnsupported && this.scene.description?.confidence ? 1 : null,
      below_min_confidence: "mask",
      tools: this.tools.all.length > 0 ? [...this.tools.all] : null,
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
    this.tools.take([]);
    this.goHome();
    this.history.clear();
  }
}

const sessions = new Map<string, Session>();

/** The session of a scene; the same for every view. */
export function sessionOf(scene: string): Session {
  const known = sessions.get(scene);
  if (known !== undefined) return known;
  const session = lasting(() => new Session(scene));
  sessions.set(scene, session);
  return session;
}

service.whenGone((scene) => sessions.delete(scene));

/** What is kept beside each session: made when it is first asked for, the same for every view. */
export function besideSession<T>(make: (session: Session) => T): (session: Session) => T {
  const all = new WeakMap<Session, T>();
  return (session) => {
    const known = all.get(session);
    if (known !== undefined) return known;
    const begun = lasting(() => make(session));
    all.set(session, begun);
    return begun;
  };
}

/** What it derives outlives the view that asked first. */
function lasting<T>(make: () => T): T {
  let begun!: T;
  $effect.root(() => void (begun = make()));
  return begun;
}
