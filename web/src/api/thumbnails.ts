/** Small frames of scenes. */

import { areUpright } from "../geometry/plane";
import { address, request } from "./client";
import { imagePlane, type Probe } from "./probes";
import { describeScene } from "./scenes";

const SIDE = 128; // samples, scan lines, and pixels of the longer side of a fan

/** A frame from the middle of the training sweep, as a PNG; null: the scene does not know where it was trained. */
export async function thumbnail(scene: string): Promise<Blob | null> {
  const { training_poses, probe, image_height, image_width } = await describeScene(scene);
  const { matrix } = training_poses.middle ?? {};
  if (matrix === undefined || probe === null) return null;
  const body = JSON.stringify({
    pose: { matrix },
    height: Math.min(SIDE, image_height ?? SIDE),
    width: Math.min(SIDE, image_width ?? SIDE),
    display: { pixel_mm: await pixel_mm(probe) },
  });
  const headers = { "Content-Type": "application/json", Accept: "image/png" };
  const answer = await request(address("/v1/scenes/{scene}/render", { scene }), { method: "POST", headers, body });
  return answer.blob();
}

/** Of a fan; null where scan lines are columns of a picture already. */
async function pixel_mm(probe: Probe): Promise<number | null> {
  const { lines_mm } = await imagePlane(probe);
  if (areUpright(lines_mm)) return null;
  const extent = (values: number[]): number => Math.max(...values) - Math.min(...values);
  const across = extent(lines_mm.flatMap(([x0, , x1]) => [x0, x1]));
  const down = extent(lines_mm.flatMap(([, z0, , z1]) => [z0, z1]));
  return Math.max(across, down) / SIDE;
}
