/** The scene file that is chosen and sent in Scenes, and the thumbnails of all scenes. */

import { SvelteMap } from "svelte/reactivity";

import { importScene, type SceneEntry, thumbnailOf } from "../api/scenes";
import { href, router } from "../page/router.svelte";
import { service } from "../page/service.svelte";
import { Sending } from "../shared/asking.svelte";
import { nameOfFile } from "../shared/text";

/** The scene file that is chosen and sent in Scenes. */
class SceneImport extends Sending {
  readonly view = "scenes";
  file = $state.raw<File | null>(null);
  name = $state("");
  isPrivate = $state(false);

  choose(file: File | null): void {
    this.file = file;
    this.problem = null;
    this.isPrivate = false;
    if (file) this.name = nameOfFile(file.name) || "scene";
  }

  /** Sends the file; the scene that it becomes is pointed out. */
  async send(file: File): Promise<void> {
    const scene = await this.transfer((told, signal) => importScene(this.name, file, this.isPrivate, told, signal));
    if (scene === null) return;
    this.choose(null);
    await service.poll();
    if (router.route.view === "scenes") location.hash = href("scenes", scene.name);
  }
}

export const sceneImport = new SceneImport();

/** A picture of each scene, by the service: held in memory or not. */
class Thumbnails {
  /** By scene; null: there will be none. */
  #known = new SvelteMap<string, string | null>();
  #asked = new Set<string>();
  #last: Promise<void> = Promise.resolve();

  /** The address of a picture; null: there is none; undefined: it is on its way. */
  of(scene: SceneEntry): string | null | undefined {
    return this.#known.get(keyOf(scene));
  }

  /** Lets go of the pictures of files that were replaced. */
  #forget(name: string): void {
    for (const [key, picture] of this.#known) {
      if (nameOf(key) !== name) continue;
      if (picture !== null) URL.revokeObjectURL(picture);
      this.#known.delete(key);
    }
  }

  /** Asks for a thumbnail, one after the other: the first time, the service draws it. */
  ask(scene: SceneEntry): void {
    const key = keyOf(scene);
    if (scene.error || this.#asked.has(key)) return;
    this.#asked.add(key);
    this.#last = this.#last.then(async () => {
      try {
        const picture = await thumbnailOf(scene.name);
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
