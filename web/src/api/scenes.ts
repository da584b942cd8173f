/** Scenes and registrations: what there is, what they say about themselves, their files, their comparison with held-out frames. */

import { address, getJson, postJson, remove, request, type Schemas, ServiceError } from "./client";
import { putFile, type Told } from "./datasets";
import { FIELDS, Gaussians } from "./gaussians";
import type { paths } from "./generated/schema";

export type SceneEntry = Schemas["SceneEntry"];
export type SceneDescription = Schemas["Scene"];

/** All pages of a list. */
async function pages<Page extends { next_page_token: string }>(ask: (query: Record<string, string>) => Promise<Page>): Promise<Page[]> {
  const all: Page[] = [];
  do all.push(await ask({ page_size: "1000", page_token: all.at(-1)?.next_page_token ?? "" }));
  while (all.at(-1)!.next_page_token !== "");
  return all;
}

/** Every scene of the service, by name. */
export async function listScenes(): Promise<SceneEntry[]> {
  return (await pages((query) => getJson("/v1/scenes", {}, { query }))).flatMap(({ scenes }) => scenes);
}

export const describeScene = (scene: string): Promise<SceneDescription> => getJson("/v1/scenes/{scene}", { scene });

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

export const deleteScene = (scene: string): Promise<void> => remove("/v1/scenes/{scene}", { scene });

export const sceneFilePath = (scene: string): string => address("/v1/scenes/{scene}/file", { scene });

/** A small PNG of the scene; null: it knows no view of its own. */
export async function thumbnailOf(scene: string): Promise<Blob | null> {
  try {
    return await (await request(address("/v1/scenes/{scene}/thumbnail.png", { scene }))).blob();
  } catch (error) {
    if (error instanceof ServiceError && error.reason === "ARTIFACT_NOT_FOUND") return null;
    throw error;
  }
}

export type Comparison = Schemas["Comparison"];
export type ComparedFrame = Schemas["ComparedFrame"];
type MetricOf<Field> = Field extends `median_${infer Name}` ? Name : never;
export type Metric = MetricOf<keyof Schemas["ComparedFrame"]>;
export type ComparedPicture =
  paths["/v1/scenes/{scene}/comparison/{index}/{what}.png"]["get"]["parameters"]["path"]["what"];

/** Begins the comparison where it is not there. Throws ServiceError DATASET_NOT_FOUND without the scene's dataset. */
export function comparisonOf(scene: string, signal: AbortSignal): Promise<Comparison> {
  return getJson("/v1/scenes/{scene}/comparison", { scene }, { signal });
}

export function comparedPicturePath(scene: string, index: number, what: ComparedPicture): string {
  return address("/v1/scenes/{scene}/comparison/{index}/{what}.png", { scene, index, what });
}

export type Registration = Schemas["NamedRegistration"];

/** Every registration of the service, by name. */
export async function listRegistrations(signal: AbortSignal): Promise<Registration[]> {
  return (await pages((query) => getJson("/v1/registrations", {}, { query, signal }))).flatMap(({ registrations }) => registrations);
}

export function deleteRegistration(registration: string): Promise<void> {
  return remove("/v1/registrations/{registration}", { registration });
}
