/** What the Scan view does at a key, and which key that is. */

import type { ScanState } from "./scan.svelte";
import { scanSettings } from "./settings.svelte";
import type { Steering } from "../session/steering.svelte";
import type { Store } from "./store/store.svelte";

export const COMMANDS = [
  "freeze", "distance", "ellipse", "angle", "text", "leave", "store", "play", "previousFrame", "nextFrame",
  "home", "snap", "undo", "redo", "slower", "faster", "large", "keys",
] as const; // prettier-ignore
export type Command = (typeof COMMANDS)[number];
export type Commands = Readonly<Record<Command, () => void>>;

interface Parts {
  scan: ScanState;
  store: Store;
  steering: () => Steering;
  openKeys: () => void;
}

export function commandsFor({ scan, store, steering, openKeys }: Parts): Commands {
  const { session, cine, marks } = scan;
  return {
    freeze: () => scan.toggleFrozen(),
    distance: () => scan.toggleTool("distance"),
    ellipse: () => scan.toggleTool("ellipse"),
    angle: () => scan.toggleTool("angle"),
    text: () => scan.toggleTool("text"),
    leave: () => marks.leave(),
    store: () => void store.picture(),
    play: () => (session.frozen ? cine.togglePlaying() : steering().togglePlaying()),
    previousFrame: () => session.frozen && cine.step(-1),
    nextFrame: () => session.frozen && cine.step(1),
    home: () => session.goHome(),
    snap: () => session.snap(),
    undo: () => session.history.undo(),
    redo: () => session.history.redo(),
    slower: () => scanSettings.changeSpeed(-1),
    faster: () => scanSettings.changeSpeed(1),
    large: () => (scanSettings.large = !scanSettings.large),
    keys: openKeys,
  };
}

/** Keys as `KeyboardEvent.key` has them, in lower case; Ctrl stands for Command, too. */
export const KEYS: Readonly<Record<Command, readonly string[]>> = {
  freeze: ["f"],
  distance: ["m", "d"],
  ellipse: ["e"],
  angle: ["a"],
  text: ["t"],
  leave: ["escape"],
  store: ["s"],
  play: [" "],
  previousFrame: [","],
  nextFrame: ["."],
  home: ["h"],
  snap: ["n"],
  undo: ["ctrl+z"],
  redo: ["ctrl+shift+z", "ctrl+y"],
  slower: ["-"],
  faster: ["+"],
  large: ["l"],
  keys: ["?"],
};

/** What goes on while its key is held. */
const GOES_ON: readonly Command[] = ["previousFrame", "nextFrame", "undo", "redo"];

/** The command of a key that was pressed; undefined where it is none, or belongs to where the focus is. */
export function commandOf(event: KeyboardEvent, singleKeys: boolean): Command | undefined {
  const target = event.target as HTMLElement;
  if (takesText(target) || event.altKey || document.querySelector("dialog[open], :popover-open") !== null) return undefined;
  if (event.key === " " && target.closest("button, a, input:not([type=range]), summary, [role=button]")) return undefined;
  const isControlled = event.ctrlKey || event.metaKey;
  if (!isControlled && !singleKeys && event.key !== "Escape") return undefined;
  const shift = isControlled && event.shiftKey ? "shift+" : ""; // the sign of a key alone has Shift in it
  const pressed = `${isControlled ? "ctrl+" : ""}${shift}${event.key.toLowerCase()}`;
  const command = COMMANDS.find((one) => KEYS[one].includes(pressed));
  return command === undefined || (event.repeat && !GOES_ON.includes(command)) ? undefined : command;
}

/** Whether what is typed there belongs there. */
export function takesText(target: HTMLElement): boolean {
  return target.closest("input:not([type=checkbox], [type=range], [type=radio]), select, textarea, [contenteditable]") !== null;
}

/** Whether the arrow keys mean something there. */
export function takesArrows(target: HTMLElement): boolean {
  return takesText(target) || target.closest("input[type=range], input[type=radio], [role=button], [role=slider], dialog") !== null;
}
