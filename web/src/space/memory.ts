/** What the tab remembers of the 3D view of a scene over a reload. */

import type { Room } from "./room.svelte";

const KEPT = ["appearance", "cut", "gizmo", "viewpoint", "look", "showSweep", "showSkin", "contact", "open", "begun"] as const;
type Kept = Partial<Pick<Room, (typeof KEPT)[number]>>;

/** Of another version of the console nothing is taken. */
const VERSION = 1;
const keyOf = (scene: string): string => `ultragray.space.${VERSION}.${scene}`;

export function remember(scene: string, room: Room): void {
  const kept = Object.fromEntries(KEPT.map((name) => [name, room[name]]));
  sessionStorage.setItem(keyOf(scene), JSON.stringify(kept));
}

export function recalled(scene: string): Kept {
  const text = sessionStorage.getItem(keyOf(scene));
  return text === null ? {} : (JSON.parse(text) as Kept);
}
