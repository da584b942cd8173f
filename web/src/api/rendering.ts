/** Frames on request: as a PNG, as DICOM; how far their poses can be trusted, and where a real one was taken.
 *
 * Poses are 16 numbers row by row, mm.
 */

import { address, poseBody, post, postJson, type Schemas } from "./client";
import { type Probe, settingsAgain, type StreamSettings } from "./contract";
import type { Described } from "./described";
import { within } from "./generated/contract";
import type { Frame } from "./stream";

export type Extrapolation = Schemas["Extrapolation"];
export type Located = Schemas["Located"];

export interface RenderedPicture {
  picture: Blob;
  /** 0 to 1; null: the scene cannot tell. */
  confidence: number | null;
}

/** A frame as a PNG. `settings` are those of RenderSettings. */
export async function renderPicture(
  scene: string,
  pose: readonly number[],
  settings: Record<string, unknown>,
  signal: AbortSignal | null = null,
): Promise<RenderedPicture> {
  const body = { ...settings, outputs: ["bmode"], pose: poseBody(pose) };
  const response = await post(address("/v1/scenes/{scene}/render", { scene }), body, { accept: "image/png", signal });
  const confidence = response.headers.get("X-Ultragray-Confidence") ?? "";
  return { picture: await response.blob(), confidence: confidence === "" ? null : Number(confidence) };
}

export type Annotation = Schemas["Annotation"];

/** Frames of one setting and one scene file, with what was set on them.
 *
 * `settings`: as they were asked for, where the frames do not tell.
 */
export async function framesAsDicom(
  frames: readonly Frame[], annotations: readonly Annotation[], settings: StreamSettings,
): Promise<Blob> {
  const headers = frames.map(({ header }) => header);
  const [first] = headers;
  const { min_confidence, below_min_confidence } = settings;
  const poses = headers.map(({ pose }) => ({ matrix: pose }));
  const body = { ...settingsAgain(first!), min_confidence, below_min_confidence, poses, frame_times_ms: frames.map(({ came_ms }) => came_ms), annotations };
  const path = address("/v1/scenes/{scene}/render", { scene: `${first!.scene}@${first!.scene_sha256}` });
  return await (await post(path, body, { accept: "application/dicom" })).blob();
}

/** Of each pose of a probe; null: the scene's own. */
export async function assessPoses(scene: string, poses: readonly (readonly number[])[], probe: Probe | null): Promise<Extrapolation[]> {
  return (await postJson("/v1/scenes/{scene}:assess", { scene }, { poses: poses.map(poseBody), probe })).extrapolations;
}

export type Planned = Schemas["Planned"];

/** Views that would teach the scene most. `settings` are those of a plan; `start`: where the way begins; null: anywhere. */
export function planViews(
  scene: string, settings: Record<string, unknown>, start: readonly number[] | null, signal: AbortSignal,
): Promise<Planned> {
  return postJson("/v1/scenes/{scene}:plan", { scene }, { ...settings, start: start && poseBody(start) }, signal);
}

/** How far the start of a search may be off. */
export interface Within {
  within_mm: number;
  within_deg: number;
}
export const WITHIN: { name: keyof Within; field: Described }[] = (["within_mm", "within_deg"] as const).map((name) => ({
  name,
  field: within.properties![name]!,
}));

/** Looks for a frame, the base64 of a PNG file, about `start`. `probe`: null for the scene's own. */
export function localize(
  scene: string,
  { start, ...asked }: { image: string; start: readonly number[]; probe: Probe | null } & (Within | { search: "anywhere" }),
  signal: AbortSignal,
): Promise<Located> {
  return postJson("/v1/scenes/{scene}:localize", { scene }, { ...asked, start: poseBody(start) }, signal);
}
