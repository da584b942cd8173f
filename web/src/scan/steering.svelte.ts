/** Scan under the hands of a person: what keys and fingers do, and how steering is liked. */

import type { Session } from "../session/session.svelte";
import type { Steering } from "../session/steering.svelte";
import type { Lens, Share } from "../shared/lens.svelte";
import type { ScanState } from "./scan.svelte";
import type { Store } from "./store.svelte";

const STORAGE = "ultragray.scan";
export const SPEEDS = [0.25, 0.5, 1, 2, 4] as const;
/** Groups that are closed until a person opens them. */
const SELDOM = ["locate", "plan", "labels", "edit", "registrations", "cases"];

/** How a person likes the Scan view, kept by the browser. */
class ScanSettings {
  /** Whether the image has nearly all of the window. */
  large = $state(false);
  /** Of steering, against the usual one. */
  speed = $state<number>(1);
  /** Whether keys without Ctrl do something. */
  singleKeys = $state(true);
  /** Names of the groups of controls that are closed. */
  closed = $state.raw<readonly string[]>(SELDOM);

  constructor() {
    try {
      const kept = JSON.parse(localStorage.getItem(STORAGE) ?? "{}") as Partial<ScanSettings>;
      if (typeof kept.large === "boolean") this.large = kept.large;
      if ((SPEEDS as readonly unknown[]).includes(kept.speed)) this.speed = kept.speed!;
      if (typeof kept.singleKeys === "boolean") this.singleKeys = kept.singleKeys;
      if (Array.isArray(kept.closed)) this.closed = kept.closed.filter((name) => typeof name === "string");
    } catch {
      // what cannot be read is left as it comes
    }
    $effect.root(() => {
      $effect(() => {
        const { large, speed, singleKeys, closed } = this;
        localStorage.setItem(STORAGE, JSON.stringify({ large, speed, singleKeys, closed }));
      });
    });
  }

  toggleGroup(name: string): void {
    this.closed = this.closed.includes(name) ? this.closed.filter((one) => one !== name) : [...this.closed, name];
  }

  /** To the next slower or faster speed. */
  changeSpeed(by: 1 | -1): void {
    const index = SPEEDS.findIndex((speed) => speed === this.speed) + by;
    this.speed = SPEEDS[Math.max(0, Math.min(SPEEDS.length - 1, index))]!;
  }
}

export const scanSettings = new ScanSettings();

interface Parts {
  scan: ScanState;
  store: Store;
  steering: () => Steering;
  openKeys: () => void;
}

/** What is done at a key. Keys are as `KeyboardEvent.key` has them, in lower case; Ctrl stands for Command, too. */
interface KeyCommand {
  keys: readonly string[];
  /** Whether it goes on while its key is held. */
  goesOn?: boolean;
  run: (parts: Parts) => unknown;
}

const ALL = {
  freeze: { keys: ["f"], run: ({ scan }) => scan.toggleFrozen() },
  distance: { keys: ["m", "d"], run: ({ scan }) => scan.toggleTool("distance") },
  ellipse: { keys: ["e"], run: ({ scan }) => scan.toggleTool("ellipse") },
  angle: { keys: ["a"], run: ({ scan }) => scan.toggleTool("angle") },
  text: { keys: ["t"], run: ({ scan }) => scan.toggleTool("text") },
  leave: { keys: ["escape"], run: ({ scan }) => scan.marks.leave() },
  store: { keys: ["s"], run: ({ store }) => store.picture() },
  play: { keys: [" "], run: ({ scan, steering }) => (scan.session.frozen ? scan.cine.togglePlaying() : steering().togglePlaying()) },
  previousFrame: { keys: [","], goesOn: true, run: ({ scan }) => scan.session.frozen && scan.cine.step(-1) },
  nextFrame: { keys: ["."], goesOn: true, run: ({ scan }) => scan.session.frozen && scan.cine.step(1) },
  home: { keys: ["h"], run: ({ scan }) => scan.session.goHome() },
  snap: { keys: ["n"], run: ({ scan }) => scan.session.snap() },
  undo: { keys: ["ctrl+z"], goesOn: true, run: ({ scan }) => scan.session.history.undo() },
  redo: { keys: ["ctrl+shift+z", "ctrl+y"], goesOn: true, run: ({ scan }) => scan.session.history.redo() },
  slower: { keys: ["-"], run: ({ scan }) => (scan.session.frozen ? scan.lens.zoomBy(-1) : scanSettings.changeSpeed(-1)) },
  faster: { keys: ["+"], run: ({ scan }) => (scan.session.frozen ? scan.lens.zoomBy(1) : scanSettings.changeSpeed(1)) },
  whole: { keys: ["0"], run: ({ scan }) => scan.lens.reset() },
  large: { keys: ["l"], run: () => (scanSettings.large = !scanSettings.large) },
  keys: { keys: ["?"], run: ({ openKeys }) => openKeys() },
} satisfies Record<string, KeyCommand>;
export type Command = keyof typeof ALL;
export type Commands = Readonly<Record<Command, () => void>>;
export const COMMANDS: readonly [Command, KeyCommand][] = Object.entries(ALL) as [Command, KeyCommand][];

export function commandsFor(parts: Parts): Commands {
  return Object.fromEntries(COMMANDS.map(([name, { run }]) => [name, () => void run(parts)])) as Commands;
}

/** The command of a key that was pressed; undefined where it is none, or belongs to where the focus is. */
export function commandOf(event: KeyboardEvent, singleKeys: boolean): Command | undefined {
  const target = event.target as HTMLElement;
  if (takesText(target) || event.altKey || document.querySelector("dialog[open], :popover-open") !== null) return undefined;
  if (event.key === " " && target.closest("button, a, input:not([type=range]), summary, [role=button]")) return undefined;
  const isControlled = event.ctrlKey || event.metaKey;
  if (!isControlled && !singleKeys && event.key !== "Escape") return undefined;
  const shift = isControlled && event.shiftKey ? "shift+" : ""; // the sign of a key alone has Shift in it
  const pressed = `${isControlled ? "ctrl+" : ""}${shift}${event.key.toLowerCase()}`;
  const [name, command] = COMMANDS.find(([, { keys }]) => keys.includes(pressed)) ?? [];
  return event.repeat && !command?.goesOn ? undefined : name;
}

/** Whether what is typed there belongs there. */
export function takesText(target: HTMLElement): boolean {
  return target.closest("input:not([type=checkbox], [type=range], [type=radio]), select, textarea, [contenteditable]") !== null;
}

/** Whether the arrow keys mean something there. */
export function takesArrows(target: HTMLElement): boolean {
  return takesText(target) || target.closest("input[type=range], input[type=radio], [role=button], [role=slider], dialog") !== null;
}

const TURN_DEG_PER_PIXEL = 0.25;
const PINCH_SHARE = 0.06; // of the distance between the fingers, before it counts
const TWIST_DEG = 4;
const LEAST_DEPTH_MM = 10;
const DEGREES = 180 / Math.PI;

interface Place {
  x: number;
  y: number;
}

interface Options {
  session: Session;
  /** Millimetres of the image plane that a pixel of the screen shows; less than 0 where left and right are exchanged. */
  acrossPerPixel_mm: () => number;
  /** Of what stands: dragging moves it where it is enlarged, a pinch enlarges it. */
  lens: Lens;
  /** Where the picture lies on the screen. */
  boxOf: () => DOMRect | undefined;
}

/** What two fingers tell. */
interface Grip {
  middle: Place;
  apart: number;
  angle_deg: number;
}

type Listener = (event: PointerEvent & { currentTarget: HTMLElement }) => void;

/** What an element does with its pointers. What lies on it and takes a press for itself stops it on its way. */
export function steeringByDragging({ session, acrossPerPixel_mm, lens, boxOf }: Options): Record<"press" | "move" | "letGo", Listener> {
  const held = new Map<number, Place>();
  let grip: (Grip & { depth_mm: number; zoom: number; pinching: boolean; twisting: boolean }) | null = null;
  let turns = false;

  function press(event: PointerEvent & { currentTarget: HTMLElement }): void {
    if ((event.target as HTMLElement).closest("button, a, input")) return;
    if (event.pointerType === "mouse" && event.button === 1) return;
    turns = event.button === 2 || event.shiftKey;
    held.set(event.pointerId, placeOf(event));
    event.currentTarget.setPointerCapture(event.pointerId);
    grip = held.size === 2 ? { ...gripOf(held), depth_mm: depthOf(session), zoom: lens.zoom, pinching: false, twisting: false } : null;
  }

  function move(event: PointerEvent): void {
    const before = held.get(event.pointerId);
    if (before === undefined) return;
    const now = placeOf(event);
    held.set(event.pointerId, now);
    if (grip !== null && held.size === 2) followGrip(grip);
    else if (held.size === 1) slideOrTurn(now.x - before.x, now.y - before.y);
  }

  function slideOrTurn(dx: number, dy: number): void {
    if (session.frozen && lens.zoom > 1) return pan(dx, dy);
    const across_mm = acrossPerPixel_mm();
    if (turns) session.turnBy([dy * TURN_DEG_PER_PIXEL, 0, dx * TURN_DEG_PER_PIXEL]);
    else session.moveBy([dx * across_mm, dy * Math.abs(across_mm), 0]);
  }

  function followGrip(from: NonNullable<typeof grip>): void {
    const now = gripOf(held);
    const twist_deg = ((now.angle_deg - from.angle_deg + 540) % 360) - 180;
    const share = now.apart / from.apart;
    if (session.frozen) {
      const box = boxOf();
      if (box) lens.zoomTo(from.zoom * share, shareIn(box, { clientX: now.middle.x, clientY: now.middle.y }));
      pan(now.middle.x - from.middle.x, now.middle.y - from.middle.y);
      from.middle = now.middle;
      return;
    }
    from.pinching ||= Math.abs(share - 1) > PINCH_SHARE && Math.abs(twist_deg) < TWIST_DEG;
    from.twisting ||= Math.abs(twist_deg) > TWIST_DEG;
    if (from.pinching) setDepth(session, from.depth_mm / share);
    const rock_deg = (now.middle.x - from.middle.x) * TURN_DEG_PER_PIXEL;
    const rotate_deg = from.twisting && !from.pinching ? twist_deg : 0;
    if (!from.pinching && (rock_deg !== 0 || rotate_deg !== 0)) session.turnBy([0, rock_deg, rotate_deg]);
    from.middle = now.middle;
    if (from.twisting) from.angle_deg = now.angle_deg;
  }

  function pan(dx: number, dy: number): void {
    const box = boxOf();
    if (box) lens.moveBy(dx / box.width, dy / box.height);
  }

  function letGo(event: PointerEvent): void {
    held.delete(event.pointerId);
    if (held.size < 2) grip = null;
  }

  return { press, move, letGo };
}

/** The share of the picture at a place of the screen. */
export function shareIn(box: DOMRect, { clientX, clientY }: { clientX: number; clientY: number }): Share {
  return { u: (clientX - box.left) / box.width, v: (clientY - box.top) / box.height };
}

function placeOf({ clientX, clientY }: PointerEvent): Place {
  return { x: clientX, y: clientY };
}

function gripOf(held: ReadonlyMap<number, Place>): Grip {
  const [a, b] = [...held.values()] as [Place, Place];
  return {
    middle: { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 },
    apart: Math.max(1, Math.hypot(a.x - b.x, a.y - b.y)),
    angle_deg: Math.atan2(b.y - a.y, b.x - a.x) * DEGREES,
  };
}

function fullDepth_mm({ probe, plane }: Session): number {
  return probe.far_mm - plane.face_depth_mm;
}

function depthOf(session: Session): number {
  return session.image.display.depth_mm ?? fullDepth_mm(session);
}

/** Whole millimetres; the full depth of the probe is none of its own. */
function setDepth(session: Session, depth_mm: number): void {
  const whole_mm = Math.max(LEAST_DEPTH_MM, Math.round(depth_mm));
  const next = whole_mm >= fullDepth_mm(session) ? null : whole_mm;
  if (next !== session.image.display.depth_mm) session.image.display = { ...session.image.display, depth_mm: next };
}
