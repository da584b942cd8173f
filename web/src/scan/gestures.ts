/** Steering by dragging on the image: one finger or the mouse slides, two fingers rotate, rock and set the depth. */

import type { Session } from "../session/session.svelte";

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
}

/** What two fingers tell. */
interface Grip {
  middle: Place;
  apart: number;
  angle_deg: number;
}

type Listener = (event: PointerEvent & { currentTarget: HTMLElement }) => void;

/** What an element does with its pointers. What lies on it and takes a press for itself stops it on its way. */
export function steeringByDragging({ session, acrossPerPixel_mm }: Options): Record<"press" | "move" | "letGo", Listener> {
  const held = new Map<number, Place>();
  let grip: (Grip & { depth_mm: number; pinching: boolean; twisting: boolean }) | null = null;
  let turns = false;

  function press(event: PointerEvent & { currentTarget: HTMLElement }): void {
    if ((event.target as HTMLElement).closest("button, a, input")) return;
    if (event.pointerType === "mouse" && event.button === 1) return;
    turns = event.button === 2 || event.shiftKey;
    held.set(event.pointerId, placeOf(event));
    event.currentTarget.setPointerCapture(event.pointerId);
    grip = held.size === 2 ? { ...gripOf(held), depth_mm: depthOf(session), pinching: false, twisting: false } : null;
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
    const across_mm = acrossPerPixel_mm();
    if (turns) session.turnBy([dy * TURN_DEG_PER_PIXEL, 0, dx * TURN_DEG_PER_PIXEL]);
    else session.moveBy([dx * across_mm, dy * Math.abs(across_mm), 0]);
  }

  function followGrip(from: NonNullable<typeof grip>): void {
    const now = gripOf(held);
    const twist_deg = ((now.angle_deg - from.angle_deg + 540) % 360) - 180;
    const share = now.apart / from.apart;
    from.pinching ||= Math.abs(share - 1) > PINCH_SHARE && Math.abs(twist_deg) < TWIST_DEG;
    from.twisting ||= Math.abs(twist_deg) > TWIST_DEG;
    if (from.pinching && !session.frozen) setDepth(session, from.depth_mm / share);
    const rock_deg = (now.middle.x - from.middle.x) * TURN_DEG_PER_PIXEL;
    const rotate_deg = from.twisting && !from.pinching ? twist_deg : 0;
    if (!from.pinching && (rock_deg !== 0 || rotate_deg !== 0)) session.turnBy([0, rock_deg, rotate_deg]);
    from.middle = now.middle;
    if (from.twisting) from.angle_deg = now.angle_deg;
  }

  function letGo(event: PointerEvent): void {
    held.delete(event.pointerId);
    if (held.size < 2) grip = null;
  }

  return { press, move, letGo };
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
