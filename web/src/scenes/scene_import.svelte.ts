/** The scene file that is chosen and sent in Scenes. */

import { importScene } from "../api/scene_files";
import { nameOfFile } from "../shared/text";
import { href, router } from "../shell/router.svelte";
import { Sending } from "../shared/sending.svelte";
import { service } from "../shell/service.svelte";

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
