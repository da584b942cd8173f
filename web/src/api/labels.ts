/** Labels of scenes: given by painted frames, and rendered. */

import { address, poseBody, post, postJson } from "./client";
import type { Probe } from "./contract";
import type { SceneDescription } from "./scenes";

/** A frame that a person painted on: the label of each pixel, 255: not painted; rows along depth, columns across scan lines. */
export interface PaintedFrame {
  pose: readonly number[];
  labels: Uint8Array;
  side: number;
}

export interface LabelTarget {
  into: string;
  replace: boolean;
  label_names: Readonly<Record<number, string>>;
  within_mm: number;
  probe: Probe | null;
}

/** Makes the scene `into` of a scene, with labels. */
export async function labelScene(scene: string, target: LabelTarget, painted: readonly PaintedFrame[]): Promise<SceneDescription> {
  const frames = await Promise.all(painted.map(async (one) => ({ pose: poseBody(one.pose), labels: await pngOf(one) })));
  return await postJson("/v1/scenes/{scene}:label", { scene }, { ...target, frames });
}

/** The label of each pixel of a frame, not scan-converted. */
export async function renderLabels(scene: string, pose: readonly number[], probe: Probe | null, side: number): Promise<Uint8Array> {
  const body = { pose: poseBody(pose), probe, outputs: ["labels"], height: side, width: side };
  const path = address("/v1/scenes/{scene}/render", { scene });
  return new Uint8Array(await (await post(path, body, { accept: "application/octet-stream" })).arrayBuffer());
}

/** A grey PNG file in base64. */
async function pngOf({ labels, side }: PaintedFrame): Promise<string> {
  const image = new ImageData(side, side);
  labels.forEach((label, index) => image.data.set([label, label, label, 255], 4 * index));
  const canvas = Object.assign(document.createElement("canvas"), { width: side, height: side });
  canvas.getContext("2d")?.putImageData(image, 0, 0);
  const url = canvas.toDataURL("image/png");
  return url.slice(url.indexOf(",") + 1);
}
