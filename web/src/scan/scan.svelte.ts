/** What a person does in Scan: freezes, looks back, measures, tells poses, and finds it all again by the address. */

import { untrack } from "svelte";

import type { Frame } from "../api/stream";
import {
  angleAt_deg, area_mm2, type Box, carried, circumference_mm, distanceBetween_mm, ellipseOf, type EllipsePoints,
  middleOf, placeLabels, type PlanePoint, rimOf, squareTo,
} from "../geometry/plane";
import {
  flangePose, fromPositionQuaternion, type Place, placeIn, type Pose, position, probePose, quaternion,
  type Reference, type Registered, replaced, withPlaceIn, withPosition,
} from "../geometry/pose";
import type { PoseForm } from "../geometry/pose_files";
import { router } from "../page/router.svelte";
import { followLink, isAsLinked, isLink, linkOf } from "../session/link";
import { besideSession, type History, type Session } from "../session/session.svelte";
import { Lens } from "../shared/lens.svelte";
import { fixed } from "../shared/text";
import { words } from "../words/words.svelte";

const MOST_FRAMES = 180;
const MOST_BYTES = 64 * 2 ** 20;
export const PLAYED_PER_SECOND = 20;

/** Frames that were put by, with the one that was shown. */
export interface Loop {
  frames: readonly Frame[];
  index: number;
}

/** The last frames of one setting, kept for looking at again: at most so many, and so many bytes. */
export class CineLoop {
  playing = $state(false);
  /** Frames of the loop that stands, and which of them is shown. */
  count = $state(0);
  index = $state(0);
  current = $state.raw<Frame | null>(null);
  frames: Frame[] = [];
  #bytes = 0;
  #settings = "";
  #timer: ReturnType<typeof setInterval> | undefined;

  /** `shown` hears of each frame of the loop that is shown. */
  constructor(private readonly shown: (frame: Frame) => void) {}

  /** Takes a live frame; the oldest ones go, and all of them where the settings are others: as on a scanner. */
  push(frame: Frame): void {
    const settings = settingsOf(frame);
    if (settings !== this.#settings) this.clear();
    this.#settings = settings;
    this.frames.push(frame);
    this.#bytes += frame.pixels.byteLength;
    while (this.frames.length > MOST_FRAMES || (this.#bytes > MOST_BYTES && this.frames.length > 1))
      this.#bytes -= this.frames.shift()!.pixels.byteLength;
  }

  clear(): void {
    this.pause();
    this.frames = [];
    this.#bytes = 0;
    this.count = this.index = 0;
    this.current = null;
  }

  /** Lets the loop stand at its newest frame. */
  stand(): void {
    this.count = this.frames.length;
    this.show(this.count - 1);
  }

  putBy(): Loop {
    return { frames: [...this.frames], index: this.index };
  }

  restore({ frames, index }: Loop): void {
    this.clear();
    for (const frame of frames) this.push(frame);
    this.count = frames.length;
    this.show(index);
  }

  show(index: number): void {
    const frame = this.frames[index];
    if (frame === undefined) return;
    this.index = index;
    this.current = frame;
    this.shown(frame);
  }

  /** Goes on by so many frames, all around. */
  step(by: number): void {
    if (this.count > 0) this.show((this.index + by + this.count) % this.count);
  }

  togglePlaying(): void {
    if (this.playing) return this.pause();
    this.playing = true;
    this.#timer = setInterval(() => this.step(1), 1000 / PLAYED_PER_SECOND);
  }

  pause(): void {
    clearInterval(this.#timer);
    this.playing = false;
  }
}

function settingsOf({ header }: Frame): string {
  const { scene_sha256, probe, slice_thickness_mm, display, height, width } = header;
  return JSON.stringify([scene_sha256, probe, slice_thickness_mm, display, height, width]);
}

export const MARK_KINDS = ["distance", "ellipse", "angle", "text"] as const;
export type MarkKind = (typeof MARK_KINDS)[number];

export interface Mark {
  readonly id: number;
  readonly kind: MarkKind;
  /** Index in the cine loop of the frame that it lies on. */
  readonly frame: number;
  readonly points: readonly PlanePoint[];
  /** Of an annotation. */
  readonly text: string;
}

const POINTS: Record<MarkKind, number> = { distance: 2, ellipse: 3, angle: 3, text: 1 };
const KEYBOARD_MM = 5; // half of what is put down for keys to move
const SECOND_AXIS = 0.6; // of the first, until it is set

/** What a person set on frozen frames: distances, ellipses, angles and texts, in mm of the image plane. */
export class Marks {
  /** What a press on the image begins. */
  tool = $state<MarkKind | null>(null);
  all = $state.raw<readonly Mark[]>([]);
  /** The one whose points are being set: its points up to `next` stand, that one follows the pointer. */
  draft = $state.raw<{ mark: Mark; next: number } | null>(null);
  /** The annotation that is being written. */
  editing = $state<number | null>(null);
  #newest = 0;

  constructor(private readonly history: History) {}

  /** Begins one of the tool at a point. */
  begin(at: PlanePoint, frame: number): void {
    if (this.tool === null) return;
    const points = Array.from({ length: POINTS[this.tool] }, () => at);
    this.draft = { mark: this.#made(this.tool, frame, points), next: Math.min(1, points.length - 1) };
  }

  /** Leads the point that is being set. */
  lead(to: PlanePoint): void {
    if (this.draft === null) return;
    this.draft = { ...this.draft, mark: withPoint(this.draft.mark, this.draft.next, to) };
  }

  /** Sets that point where it is; the last one ends the mark. */
  settle(): void {
    if (this.draft === null) return;
    const { mark, next } = this.draft;
    if (next + 1 < mark.points.length) {
      this.draft = { mark: mark.kind === "ellipse" ? withSecondAxis(mark) : mark, next: next + 1 };
      return;
    }
    this.draft = null;
    this.#add(mark);
  }

  /** Puts one of the tool about a point, for keys to move. */
  putAbout({ x_mm, z_mm }: PlanePoint, frame: number): Mark | null {
    if (this.tool === null) return null;
    const [left, right] = [x_mm - KEYBOARD_MM, x_mm + KEYBOARD_MM];
    const points = {
      distance: [{ x_mm: left, z_mm }, { x_mm: right, z_mm }],
      ellipse: [{ x_mm: left, z_mm }, { x_mm: right, z_mm }, { x_mm, z_mm: z_mm + SECOND_AXIS * KEYBOARD_MM }],
      angle: [{ x_mm: right, z_mm: z_mm - KEYBOARD_MM }, { x_mm: left, z_mm }, { x_mm: right, z_mm }],
      text: [{ x_mm, z_mm }],
    }[this.tool];
    const mark = this.#made(this.tool, frame, points);
    this.#add(mark);
    return mark;
  }

  /** Moves a point; what is moved without a pause is undone as one step. */
  move(id: number, point: number, to: PlanePoint): void {
    const next = this.all.map((mark) => (mark.id === id ? withPoint(mark, point, to) : mark));
    this.#put(next, `mark ${id}.${point}`);
  }

  /** Writes an annotation; an empty one goes. */
  write(id: number, text: string): void {
    this.editing = null;
    const before = this.all.find((mark) => mark.id === id);
    if (before === undefined) return;
    if (text.trim() === "") this.remove(id);
    else if (text !== before.text) this.#put(this.all.map((mark) => (mark.id === id ? { ...mark, text: text.trim() } : mark)));
  }

  remove(id: number): void {
    this.#put(this.all.filter((mark) => mark.id !== id));
  }

  removeAll(): void {
    this.draft = null;
    if (this.all.length > 0) this.#put([]);
  }

  /** Leaves what is being done: first the mark that is being set, then the tool. */
  leave(): void {
    if (this.draft !== null) this.draft = null;
    else this.tool = null;
  }

  /** Takes others in place of all, which is no step of its own. */
  restore(marks: readonly Mark[]): void {
    this.all = marks;
    this.draft = this.editing = null;
  }

  /** A, B, C … of what was measured; annotations have none. */
  letterOf(id: number): string {
    const index = this.all.filter(({ kind }) => kind !== "text").findIndex((mark) => mark.id === id);
    return index < 0 ? "" : letter(index);
  }

  #add(mark: Mark): void {
    this.#put([...this.all, mark]);
    if (mark.kind === "text") this.editing = mark.id;
  }

  #put(next: readonly Mark[], run: string | null = null): void {
    this.history.change((marks: readonly Mark[]) => this.restore(marks), this.all, next, { run, of: this });
    this.all = next;
  }

  #made(kind: MarkKind, frame: number, points: readonly PlanePoint[]): Mark {
    return { id: ++this.#newest, kind, frame, points, text: "" };
  }
}

/** A to Z, then AA, AB … */
export function letter(index: number): string {
  const last = String.fromCharCode(65 + (index % 26));
  return index < 26 ? last : letter(Math.floor(index / 26) - 1) + last;
}

function withPoint(mark: Mark, point: number, to: PlanePoint): Mark {
  const points = mark.points.map((before, index) => (index === point ? to : before));
  if (mark.kind !== "ellipse") return { ...mark, points };
  const [a, b] = points as unknown as EllipsePoints;
  const third = point === 2 ? squareTo(a, b, to) : carried(mark.points as EllipsePoints, a, b);
  return { ...mark, points: [a, b, third] };
}

function withSecondAxis(mark: Mark): Mark {
  const [a, b] = mark.points as EllipsePoints;
  const { x_mm, z_mm } = middleOf(a, b);
  const half = SECOND_AXIS / 2;
  const third = { x_mm: x_mm - half * (b.z_mm - a.z_mm), z_mm: z_mm + half * (b.x_mm - a.x_mm) };
  return { ...mark, points: [a, b, third] };
}

const LETTER = { width: 11, height: 15 }; // at 13 pixels, of one

/** "12.0 × 8.0 mm, circumference 31.7 mm, area 0.75 cm²"; of an annotation its text. */
export function resultOf({ kind, points, text }: Mark): string {
  switch (kind) {
    case "distance":
      return `${fixed(distanceBetween_mm(points[0]!, points[1]!), 1)} mm`;
    case "angle":
      return `${fixed(angleAt_deg(points as EllipsePoints), 1)}°`;
    case "ellipse": {
      const ellipse = ellipseOf(points as EllipsePoints);
      const axes = `${fixed(2 * ellipse.first_mm, 1)} × ${fixed(2 * ellipse.second_mm, 1)} mm`;
      return words.scan.results.ellipse(axes, `${fixed(circumference_mm(ellipse), 1)} mm`, `${fixed(area_mm2(ellipse) / 100, 2)} cm²`);
    }
    case "text":
      return text;
  }
}

export interface Lettered {
  letter: string;
  box: Box;
}

/** The letters of marks, each near its mark and none over another, or over what is marked. */
export function lettersOf(
  shown: readonly Mark[],
  marks: Marks,
  screenOf: (point: PlanePoint) => { x: number; y: number },
  area: Box,
): Lettered[] {
  const lettered = shown.filter(({ kind }) => kind !== "text");
  const taken = shown.flatMap((mark) => boxesOf(mark, screenOf));
  const labels = lettered.map((mark) => ({ ...screenOf(mark.points.at(mark.kind === "angle" ? 1 : 0)!), ...LETTER }));
  const boxes = placeLabels(labels, area, taken);
  return lettered.map((mark, index) => ({ letter: marks.letterOf(mark.id), box: boxes[index]! }));
}

const CROSS = 7; // half of the cross of a point, in pixels, and what is free beside it
const LINE = 3; // what is free beside a line
const PIECES = 24;

/** Boxes that together cover what a mark consists of, and an ellipse what it surrounds. */
function boxesOf({ kind, points }: Mark, screenOf: (point: PlanePoint) => { x: number; y: number }): Box[] {
  const at = points.map(screenOf);
  const crosses = at.map((point) => boxBetween(point, point, CROSS));
  if (kind === "ellipse") {
    const middle = screenOf(ellipseOf(points as EllipsePoints).centre);
    return [...crosses, ...rimOf(points as EllipsePoints, PIECES).map((point) => boxBetween(middle, screenOf(point), LINE))];
  }
  const lines = at.slice(1).flatMap((to, index) => {
    const from = at[index]!;
    const along = (share: number) => ({ x: from.x + (to.x - from.x) * share, y: from.y + (to.y - from.y) * share });
    return Array.from({ length: PIECES }, (_, piece) => boxBetween(along(piece / PIECES), along((piece + 1) / PIECES), LINE));
  });
  return [...crosses, ...lines];
}

function boxBetween(a: { x: number; y: number }, b: { x: number; y: number }, beside: number): Box {
  const [left, top] = [Math.min(a.x, b.x) - beside, Math.min(a.y, b.y) - beside];
  return { left, top, width: Math.abs(a.x - b.x) + 2 * beside, height: Math.abs(a.y - b.y) + 2 * beside };
}

/** What is kept of the Scan view of each scene while another view is shown: the frozen frames with what was set on them. */
export class ScanState {
  readonly cine: CineLoop;
  readonly marks: Marks;
  /** Of what stands; the live image is shown whole. */
  readonly lens = new Lens();

  constructor(readonly session: Session) {
    this.cine = new CineLoop((frame) => session.lookAt(frame.header.pose.flat()));
    this.marks = new Marks(session.history);
  }

  /** Lets the newest frame stand, with the probe where it was taken. */
  freeze(): void {
    const { session, cine } = this;
    const newest = cine.frames.at(-1);
    if (session.frozen || newest === undefined) return;
    const before = session.pose;
    this.#forgetFrozen();
    session.freeze(newest.header.pose.flat());
    cine.stand();
    const loop = cine.putBy();
    session.history.add({ undo: () => this.#release(before), redo: () => this.#hold(loop, []), of: this });
  }

  /** Goes on live from where the frame shown was taken; what was measured goes with the frames. */
  unfreeze(): void {
    const { session, cine, marks } = this;
    if (!session.frozen) return;
    const [loop, set] = [cine.putBy(), marks.all];
    this.#release();
    session.history.add({ undo: () => this.#hold(loop, set), redo: () => this.#release(), of: this });
  }

  toggleFrozen(): void {
    if (this.session.frozen) this.unfreeze();
    else this.freeze();
  }

  /** Takes a tool up, or lays it down. What is measured stands still: it freezes. */
  toggleTool(kind: MarkKind): void {
    this.marks.draft = null;
    this.freeze();
    this.marks.tool = this.marks.tool === kind || !this.session.frozen ? null : kind;
  }

  /** The marks of the frame that is shown, the one that is being set among them. */
  get shown(): readonly Mark[] {
    if (!this.session.frozen) return [];
    const { all, draft } = this.marks;
    return [...all, ...(draft === null ? [] : [draft.mark])].filter(({ frame }) => frame === this.cine.index);
  }

  /** Lets go of what stood, where the scene has become another one. */
  forget(): void {
    this.#forgetFrozen();
    this.#clear();
  }

  #hold(loop: Loop, marks: readonly Mark[]): void {
    this.session.freeze(loop.frames[loop.index]!.header.pose.flat());
    this.cine.restore(loop);
    this.marks.restore(marks);
  }

  #release(pose = this.session.pose): void {
    this.#clear();
    this.session.unfreeze(pose);
  }

  #clear(): void {
    this.cine.clear();
    this.marks.restore([]);
    this.marks.tool = null;
    this.lens.reset();
  }

  /** Only the newest frozen loop can be had back: they are large. */
  #forgetFrozen(): void {
    this.session.history.forget(this);
    this.session.history.forget(this.marks);
  }
}

/** What is kept of a scene; a session that was forgotten begins anew. */
export const scanOf = besideSession((session) => new ScanState(session));

export const MOST_MM = 10_000; // beyond, a typed position is a slip

/** How poses are told in a session: against what, in which form. */
export class PoseTelling {
  reference = $state<Reference>("absolute");
  form = $state<PoseForm>("json");
  /** Tells poses as a robot or a tracker does; null: of the probe, in the scene. */
  registered = $state.raw<Registered | null>(null);
  /** Whether relative poses are told against the mark; else against Home. */
  fromMark = $state(false);
  mark = $state.raw<Pose | null>(null);
  readonly other = $derived.by(() => (this.fromMark && this.mark ? this.mark : this.session.held(this.session.scene.home)));

  constructor(private readonly session: Session) {}

  setMark(pose: Pose): void {
    this.mark = pose;
    this.fromMark = true;
    if (this.reference === "absolute") this.reference = "relativeProbe";
  }

  /** A pose of the probe as it is shown: in the scene, or by the registration. */
  told(pose: Pose): Pose {
    return this.registered === null ? pose : flangePose(this.registered, pose);
  }

  /** Its inverse. */
  meant(told: Pose): Pose {
    return this.registered === null ? told : probePose(this.registered, told);
  }

  place(pose: Pose): Place {
    return placeIn(this.told(pose), this.reference, this.told(this.other));
  }

  /** Moves the probe along one axis of what is told. */
  setPosition(index: number, value_mm: number): void {
    const place = this.place(this.session.pose);
    const moved = this.#meantBy({ ...place, position_mm: replaced(place.position_mm, index, value_mm) });
    const turn = fromPositionQuaternion([0, 0, 0], quaternion(this.session.pose)); // its digits stay as they are
    this.session.pose = withPosition(turn, position(moved));
  }

  /** Turns the probe about its face. */
  setAngle(index: number, value_deg: number): void {
    const place = this.place(this.session.pose);
    const turned = this.#meantBy({ ...place, angles_deg: replaced(place.angles_deg, index, value_deg) });
    this.session.turnTo(quaternion(turned));
  }

  #meantBy(place: Place): Pose {
    return this.meant(withPlaceIn(place, this.reference, this.told(this.other)));
  }
}

/** That of a session; the same for every view. */
export const tellingOf = besideSession((session) => new PoseTelling(session));

const WRITTEN_EVERY_MS = 250;

type Values = Record<string, string | null>;

/** The address of Scan: what a reload, a sent link or a step back brings back. */
export class Address {
  /** What of the address that was opened cannot be used. */
  refused = $state.raw<readonly string[]>([]);
  /** Whether the session is what the address told when the view was opened. */
  #taken = $state(false);
  #arrivals: number | null = null;
  #jumps = 0;
  #latest: Values = {};
  #timer: ReturnType<typeof setTimeout> | undefined;

  /** Must be made while a component is being made; ends with it. */
  constructor(private readonly scan: ScanState) {
    const { session } = scan;
    $effect(() => {
      if (!session.scene.known) return;
      const { arrivals } = router;
      untrack(() => void this.#take(arrivals));
    });
    $effect(() => {
      if (!session.scene.known || !this.#taken) return;
      const [values, jumps] = [linkOf(session), session.jumps];
      untrack(() => this.#note(values, jumps));
    });
    $effect(() => () => clearTimeout(this.#timer));
  }

  /** The whole address of what is shown. */
  link(): string {
    this.#write();
    return new URL(router.link, location.href).href;
  }

  async #take(arrivals: number): Promise<void> {
    const opened = this.#arrivals === null;
    this.#arrivals = arrivals;
    if (!this.#isHere) return;
    const { session } = this.scan;
    const { kept } = router;
    // An address that tells nothing is the way back from another view, unless one came to it within this one.
    const follows = opened ? isLink(kept) : true;
    if (follows && !isAsLinked(session, kept)) {
      this.#taken = false;
      this.scan.unfreeze();
      this.refused = await followLink(session, kept);
    }
    this.#jumps = session.jumps;
    this.#latest = linkOf(session);
    this.#taken = true;
  }

  #note(values: Values, jumps: number): void {
    const isJump = jumps !== this.#jumps;
    this.#jumps = jumps;
    if (isJump && JSON.stringify(values) !== JSON.stringify(this.#latest)) {
      this.#write();
      this.#latest = values;
      if (this.#isHere) router.keep(values, { entry: true });
      return;
    }
    this.#latest = values;
    this.#timer ??= setTimeout(() => this.#write(), WRITTEN_EVERY_MS);
  }

  #write(): void {
    clearTimeout(this.#timer);
    this.#timer = undefined;
    if (this.#isHere) router.keep(this.#latest);
  }

  /** Whether the address is still that of this view: it changes before the view goes. */
  get #isHere(): boolean {
    const { view, name } = router.route;
    return view === "scan" && name === this.scan.session.name;
  }
}
