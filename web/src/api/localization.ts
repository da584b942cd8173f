/** Where in a scene a real frame was taken. */

import { address, request, type Schemas } from "./client";
import type { Described } from "./described";
import { within } from "./generated/contract";
import type { Probe } from "./probes";

export type Located = Schemas["Located"];

/** How far the start may be off. */
export interface Within {
  within_mm: number;
  within_deg: number;
}
export const WITHIN: { name: keyof Within; field: Described }[] = (["within_mm", "within_deg"] as const).map((name) => ({
  name,
  field: within.properties![name]!,
}));

/** Looks for a frame, the base64 of a PNG file, about `start`: 16 numbers row by row, mm. `probe`: null for the scene's own. */
export async function localize(
  scene: string,
  asked: { image: string; start: readonly number[]; probe: Probe | null } & Within,
  signal: AbortSignal,
): Promise<Located> {
  const matrix = [0, 4, 8, 12].map((row) => asked.start.slice(row, row + 4));
  const answer = await request(address("/v1/scenes/{scene}:localize", { scene }), {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ ...asked, start: { matrix } }),
    signal,
  });
  return (await answer.json()) as Located;
}
