/** What moves the probe by itself while it is held: keys, a gamepad, the playback of a track. */

import { scaled, type Vector } from "../geometry/pose";
import type { Session } from "./session.svelte";

const SPEED_MM_S = 25;
const SPEED_DEG_S = 30;
const FINE = 0.2; // with Alt: browsers keep Ctrl with the page keys for themselves
const TAP_S = 0.02; // a short press moves at least so long
const DEAD_ZONE = 0.12;
const PLAYED_VIEWS_PER_SECOND = 12;

type Motion = { along: Vector; turn: Vector };

const STILL: Vector = [0, 0, 0];
/** By key; with Shift they turn. Arrows: lateral and elevation, page keys: axial. */
const SLIDES: Record<string, Vector> = {
  ArrowLeft: [-1, 0, 0],
  ArrowRight: [1, 0, 0],
  ArrowUp: [0, -1, 0],
  ArrowDown: [0, 1, 0],
  PageUp: [0, 0, -1],
  PageDown: [0, 0, 1],
};

type PadCommands = Record<"freeze" | "snap" | "store" | "home", () => void>;
/** Buttons of a gamepad in the standard layout. */
const PAD_BUTTONS: readonly (readonly [number, keyof PadCommands])[] = [[0, "freeze"], [1, "snap"], [2, "store"], [3, "home"]];

export class Steering {
  playing = $state(false);
  gamepad = $state<string | null>(null);
  #held = new Map<string, { shift: boolean; fine: boolean }>();
  #request = 0;
  #last_ms = 0;
  #direction = 1;
  #pressed: boolean[] = [];

  constructor(
    private readonly session: Session,
    /** What the buttons of a gamepad do. */
    private readonly commands: Partial<PadCommands> = {},
    /** How many times as fast as usual. */
    private readonly speed: () => number = () => 1,
  ) {
    addEventListener("gamepadconnected", this.#connected);
    addEventListener("gamepaddisconnected", this.#connected);
    addEventListener("blur", this.#release);
    this.#connected();
  }

  close(): void {
    removeEventListener("gamepadconnected", this.#connected);
    removeEventListener("gamepaddisconnected", this.#connected);
    removeEventListener("blur", this.#release);
    cancelAnimationFrame(this.#request);
  }

  /** Takes a key that is pressed; true where it steers. */
  press(event: KeyboardEvent): boolean {
    if (!(event.key in SLIDES) || event.ctrlKey || event.metaKey) return false;
    if (!this.#held.has(event.key)) this.#step(event.key, event.shiftKey, event.altKey, TAP_S);
    this.#held.set(event.key, { shift: event.shiftKey, fine: event.altKey });
    this.#run();
    return true;
  }

  release(event: KeyboardEvent): void {
    this.#held.delete(event.key);
  }

  /** Stops what moves the probe by itself. */
  halt(): void {
    this.playing = false;
    this.#held.clear();
  }

  togglePlaying(): void {
    if (this.session.frozen) {
      this.session.refusals += 1;
      return;
    }
    this.playing = !this.playing;
    if (this.playing && !this.session.onTrack) this.session.returnToTrack();
    this.#run();
  }

  #connected = (): void => {
    this.gamepad = connectedPad()?.id ?? null;
    this.#run();
  };

  #release = (): void => this.#held.clear();

  #run(): void {
    if (this.#request !== 0) return;
    this.#last_ms = performance.now();
    this.#request = requestAnimationFrame(this.#tick);
  }

  #tick = (now_ms: number): void => {
    const seconds = Math.min(0.1, Math.max(0, (now_ms - this.#last_ms) / 1000));
    this.#last_ms = now_ms;
    for (const [key, { shift, fine }] of this.#held) this.#step(key, shift, fine, seconds);
    if (this.gamepad !== null) this.#followPad(seconds);
    if (this.playing) this.#play(seconds);
    const goesOn = this.#held.size > 0 || this.playing || this.gamepad !== null;
    this.#request = goesOn ? requestAnimationFrame(this.#tick) : 0;
  };

  #followPad(seconds: number): void {
    const pad = connectedPad();
    if (pad === undefined) return;
    this.#move(motionOf(pad), seconds);
    const pressed = pad.buttons.map((button) => button.pressed);
    for (const [button, command] of PAD_BUTTONS) if (pressed[button] && !this.#pressed[button]) this.commands[command]?.();
    this.#pressed = pressed;
  }

  #play(seconds: number): void {
    const last = this.session.track.length - 1;
    let place = this.session.place + this.#direction * PLAYED_VIEWS_PER_SECOND * seconds;
    if (place >= last) [place, this.#direction] = [last, -1];
    if (place <= 0) [place, this.#direction] = [0, 1];
    this.session.goTo(place);
  }

  #step(key: string, shift: boolean, fine: boolean, seconds: number): void {
    const along = SLIDES[key]!;
    const turn: Vector = [along[1], along[2], along[0]]; // to the side rotates, up and down tilts, pages rock
    this.#move(shift ? { along: STILL, turn } : { along, turn: STILL }, seconds * (fine ? FINE : 1));
  }

  #move({ along, turn }: Motion, seconds: number): void {
    seconds *= this.speed();
    if (along.some((value) => value !== 0)) this.session.moveBy(scaled(along, SPEED_MM_S * seconds));
    if (turn.some((value) => value !== 0)) this.session.turnBy(scaled(turn, SPEED_DEG_S * seconds));
  }
}

/** Left stick: slide; right stick: rotate and tilt; triggers: axial; shoulder buttons: rock. */
function motionOf(pad: Gamepad): Motion {
  const stick = (index: number): number => {
    const value = pad.axes[index] ?? 0;
    return Math.abs(value) < DEAD_ZONE ? 0 : value;
  };
  const button = (index: number): number => pad.buttons[index]?.value ?? 0;
  return {
    along: [stick(0), stick(1), button(7) - button(6)],
    turn: [stick(3), button(5) - button(4), stick(2)],
  };
}

/** The browser tells of gamepads only where the page is trusted: not over plain HTTP from another machine, say. */
function connectedPad(): Gamepad | undefined {
  try {
    return (navigator.getGamepads?.() ?? []).find((pad) => pad?.connected) ?? undefined;
  } catch {
    return undefined; // the page may not be allowed to ask
  }
}
