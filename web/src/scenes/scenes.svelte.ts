/** The scene file that is chosen and sent in Scenes, and the thumbnails of the scenes that are held in memory. */

import { SvelteMap } from "svelte/reactivity";

import { imagePlane } from "../api/contract";
import { renderPicture } from "../api/rendering";
import { describeScene, importScene, type SceneEntry } from "../api/scenes";
import { squarePixel_mm } from "../geometry/plane";
import { href, router } from "../page/router.svelte";
import { service } from "../page/service.svelte";
import { Sending } from "../shared/asking.svelte";
import { nameOfFile } from "../shared/text";

/** The scene file that is chosen and sent in Scenes. */
class SceneImport extends Sending {
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

const SIDE = 128; // samples, scan lines, and pixels of the longer side of a fan

/** A frame from the middle of the training sweep, as a PNG; null: the scene does not know where it was trained. */
async function thumbnail(scene: string): Promise<Blob | null> {
  const { training_poses, probe, image_height, image_width } = await describeScene(scene);
  const { matrix } = training_poses.middle ?? {};
  if (matrix === undefined || probe === null) return null;
  const size = { height: Math.min(SIDE, image_height ?? SIDE), width: Math.min(SIDE, image_width ?? SIDE) };
  const display = { pixel_mm: squarePixel_mm((await imagePlane(probe)).lines_mm, SIDE) };
  return (await renderPicture(scene, matrix.flat(), { ...size, display })).picture;
}

/** The thumbnails of the scenes that are held in memory: rendering one of another would load it, and let go of one in use. */
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
