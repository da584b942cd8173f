/** Single frames, rendered on request. */

import { address, request } from "./client";

export interface RenderedPicture {
  picture: Blob;
  /** 0 to 1; null: the scene cannot tell. */
  confidence: number | null;
}

/** A frame as a PNG. `settings` are those of RenderSettings; `pose` 16 numbers row by row, mm. */
export async function renderPicture(
  scene: string,
  pose: readonly number[],
  settings: Record<string, unknown>,
  signal: AbortSignal,
): Promise<RenderedPicture> {
  const matrix = [0, 4, 8, 12].map((start) => pose.slice(start, start + 4));
  const response = await request(address("/v1/scenes/{scene}/render", { scene }), {
    method: "POST",
    headers: { "Content-Type": "application/json", Accept: "image/png" },
    body: JSON.stringify({ ...settings, outputs: ["bmode"], pose: { matrix } }),
    signal,
  });
  const told = response.headers.get("X-Ultragray-Confidence") ?? "";
  return { picture: await response.blob(), confidence: told === "" ? null : Number(told) };
}
