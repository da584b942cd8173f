/** Scene files, and which scenes are held in memory. */

import { request, segment, sendJson } from "./client";
import type { SceneDescription } from "./scenes";
import { putFile, type Told } from "./upload";

export const SCENE_SUFFIX = ".ugr";

export async function loadScene(scene: string): Promise<void> {
  await sendJson("POST", `/v1/scenes/${segment(scene)}:load`);
}

export async function unloadScene(scene: string): Promise<void> {
  await sendJson("POST", `/v1/scenes/${segment(scene)}:unload`);
}

export function importScene(scene: string, file: File, told: Told, signal: AbortSignal): Promise<SceneDescription> {
  return putFile(`/v1/scenes/${segment(scene)}`, new Blob([file]), told, signal);
}

export async function deleteScene(scene: string): Promise<void> {
  await request(`/v1/scenes/${segment(scene)}`, { method: "DELETE" });
}

export function sceneFilePath(scene: string): string {
  return `/v1/scenes/${segment(scene)}/file`;
}
