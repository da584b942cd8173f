/** Scene files, and which scenes are held in memory. */

import { address, postJson, remove } from "./client";
import type { SceneDescription } from "./scenes";
import { putFile, type Told } from "./upload";

export const SCENE_SUFFIX = ".ugr";

export async function loadScene(scene: string): Promise<void> {
  await postJson("/v1/scenes/{scene}:load", { scene });
}

export async function unloadScene(scene: string): Promise<void> {
  await postJson("/v1/scenes/{scene}:unload", { scene });
}

/** Others do not see a private scene. */
export function importScene(
  scene: string,
  file: File,
  isPrivate: boolean,
  told: Told,
  signal: AbortSignal,
): Promise<SceneDescription> {
  const path = address("/v1/scenes/{scene}", { scene }) + (isPrivate ? "?private=true" : "");
  return putFile(path, new Blob([file]), told, signal);
}

export function deleteScene(scene: string): Promise<void> {
  return remove("/v1/scenes/{scene}", { scene });
}

export function sceneFilePath(scene: string): string {
  return address("/v1/scenes/{scene}/file", { scene });
}
