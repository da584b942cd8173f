/** What the Scan view does at a key, and which key that is. */

export const COMMANDS = [
  "freeze", "distance", "ellipse", "angle", "text", "leave", "store", "play", "previousFrame", "nextFrame",
  "home", "snap", "undo", "redo", "slower", "faster", "large", "keys",
] as const; // prettier-ignore
export type Command = (typeof COMMANDS)[number];
export type Commands = Readonly<Record<Command, () => void>>;

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
  if (takesText(target) || event.altKey || document.querySelector("dialog[open]") !== null) return undefined;
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
