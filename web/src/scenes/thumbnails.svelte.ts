/** The thumbnails of the scenes that are held in memory: rendering one of another would load it, and let go of one in use. */

import { SvelteMap } from "svelte/reactivity";

import type { SceneEntry } from "../api/scenes";
import { thumbnail } from "../api/thumbnails";

class Thumbnails {
  /** By scene; null: there will be none. */
  #known = new SvelteMap<string, string | null>();
  #asked = new Set<string>();
  #last: Promise<void> = Promise.resolve();

  /** The address of a picture; null: there is none (yet). */
  of(scene: SceneEntry): string | null {
    return this.#known.get(keyOf(scene)) ?? null;
  }

  /** Whether a picture is on its way. */
  isComing(scene: SceneEntry): boolean {
    return scene.loaded && !this.#known.has(keyOf(scene));
  }

  /** Lets go of the pictures of files that were replaced. */
  #forget(name: string): void {
    for (const [key, picture] of this.#known) {
      if (nameOf(key) !== name) continue;
      if (picture !== null) URL.revokeObjectURL(picture);
      this.#known.delete(key);
    }
  }

  /** Asks for a thumbnail, one after the other: people who scan come first. */
  ask(scene: SceneEntry): void {
    const key = keyOf(scene);
    if (!scene.loaded || this.#asked.has(key)) return;
    this.#asked.add(key);
    this.#last = this.#last.then(async () => {
      try {
        const picture = await thumbnail(scene.name);
        this.#forget(scene.name);
        this.#known.set(key, picture && URL.createObjectURL(picture));
      } catch {
        this.#asked.delete(key); // when the list is shown again
      }
    });
  }
}

/** Another file of the same name is another scene. */
function keyOf({ name, file_bytes, changed_at }: SceneEntry): string {
  return JSON.stringify([name, file_bytes, changed_at]);
}

function nameOf(key: string): unknown {
  return (JSON.parse(key) as unknown[])[0];
}

export const thumbnails = new Thumbnails();
