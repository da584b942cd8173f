/** Scenes: what there is, what they say about themselves, their Gaussians and training views. */

import { getJson, request, segment } from "./client";

export interface LinearProbe {
  kind: "linear";
  width_mm: number;
  near_mm: number;
  far_mm: number;
}
export interface ConvexProbe {
  kind: "convex";
  opening_angle_deg: number;
  near_mm: number;
  far_mm: number;
}
export interface PhasedProbe {
  kind: "phased";
  opening_angle_deg: number;
  far_mm: number;
}
export type Probe = LinearProbe | ConvexProbe | PhasedProbe;

export interface SceneEntry {
  name: string;
  loaded: boolean;
  /** Whether it may be deleted. */
  removable: boolean;
  gaussian_count?: number;
  image_height?: number;
  image_width?: number;
  file_bytes?: number;
  error?: { reason: string; detail: string };
}

export interface Point {
  x: number;
  y: number;
  z: number;
}

export interface PoseOut {
  matrix: number[][];
}

/** How well a scene knows the confidence of its frames. */
export interface ConfidenceFit {
  /** Mean absolute error on the views that it was fitted on. */
  error: number;
  fitted_on: number;
}

export interface SceneDescription {
  name: string;
  loaded: boolean;
  loaded_processes: number;
  file_bytes: number;
  gaussian_count: number;
  sh_degree: number;
  intensity: string;
  centre_mm: Point;
  bounds: { min_mm: Point; max_mm: Point };
  probe: Probe | null;
  image_height: number | null;
  image_width: number | null;
  training_poses: { count: number; middle: PoseOut | null };
  metrics: Record<string, number> | null;
  dataset_name: string | null;
  dataset_sha256: string | null;
  label_names: Record<string, string> | null;
  /** null: the scene cannot tell the confidence of its frames. */
  confidence: ConfidenceFit | null;
}

/** The Gaussians of a scene as points: float32 [N, 6], x, y, z in mm, intensity, transmittance, mean sigma in mm. */
export interface GaussianPoints {
  count: number;
  values: Float32Array;
}

/** Every scene of the service, by name. */
export async function listScenes(): Promise<SceneEntry[]> {
  const scenes: SceneEntry[] = [];
  let token = "";
  do {
    const page = await getJson<{ scenes: SceneEntry[]; next_page_token: string }>(
      `/v1/scenes?page_size=1000&page_token=${segment(token)}`,
    );
    scenes.push(...page.scenes);
    token = page.next_page_token;
  } while (token !== "");
  return scenes;
}

export function describeScene(scene: string): Promise<SceneDescription> {
  return getJson(`/v1/scenes/${segment(scene)}`);
}

/** An even selection of at most `limit` Gaussians. */
export async function sceneGaussians(scene: string, limit: number): Promise<GaussianPoints> {
  const response = await request(`/v1/scenes/${segment(scene)}/gaussians?limit=${limit}`);
  const buffer = await response.arrayBuffer();
  const length = new DataView(buffer).getUint32(0, true);
  const { count } = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length))) as { count: number };
  return { count, values: new Float32Array(buffer, 4 + length, count * 6) };
}

/** The poses that the scene was trained from, each 16 numbers row by row. */
export async function trainingPoses(scene: string): Promise<number[][]> {
  return (await getJson<{ poses: number[][] }>(`/v1/scenes/${segment(scene)}/training-poses`)).poses;
}
