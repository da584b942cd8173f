/** Scenes: what there is, what they say about themselves, their Gaussians and training views. */

import { address, getJson, request, type Schemas } from "./client";
import { FIELDS, Gaussians } from "./gaussians";

export type SceneEntry = Schemas["SceneEntry"];
export type SceneDescription = Schemas["Scene"];

/** Every scene of the service, by name. */
export async function listScenes(): Promise<SceneEntry[]> {
  const scenes: SceneEntry[] = [];
  let token = "";
  do {
    const page = await getJson("/v1/scenes", {}, { query: { page_size: "1000", page_token: token } });
    scenes.push(...page.scenes);
    token = page.next_page_token;
  } while (token !== "");
  return scenes;
}

export function describeScene(scene: string): Promise<SceneDescription> {
  return getJson("/v1/scenes/{scene}", { scene });
}

/** An even selection of at most `limit` Gaussians. */
export async function sceneGaussians(scene: string, limit: number): Promise<Gaussians> {
  const fields = FIELDS.map((field) => `&fields=${field}`).join("");
  const response = await request(`${address("/v1/scenes/{scene}/gaussians", { scene })}?limit=${limit}${fields}`);
  const buffer = await response.arrayBuffer();
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length))) as { count: number; total: number };
  return new Gaussians(header.count, header.total, new Float32Array(buffer, 4 + length, header.count * FIELDS.length));
}

export type TrainingPoses = Schemas["ScenePoses"];

/** The poses that the scene was trained from, each 16 numbers row by row, and how far each was corrected. */
export async function trainingPoses(scene: string): Promise<TrainingPoses> {
  return await getJson("/v1/scenes/{scene}/training-poses", { scene });
}
