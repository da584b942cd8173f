/** Frames as a DICOM file, which the service renders once more from what they say of themselves. */

import { address, request } from "./client";
import type { FrameHeader, StreamSettings } from "./stream";

export const MOST_DICOM_FRAMES = 100; // of one file: the service lets so many wait beside the live ones

/** Frames of one setting and one scene file. `settings`: as they were asked for, where the frames do not tell. */
export async function framesAsDicom(headers: readonly FrameHeader[], settings: StreamSettings): Promise<Blob> {
  const { scene, scene_sha256, probe, display, rendered_height, rendered_width, slice_thickness_mm } = headers[0]!;
  const { contact, tools, ghost } = headers[0]!;
  const body = {
    poses: headers.map(({ pose }) => ({ matrix: pose })),
    height: rendered_height,
    width: rendered_width,
    probe,
    display,
    slice_thickness_mm,
    contact,
    tools,
    ghost,
    min_confidence: settings.min_confidence,
    below_min_confidence: settings.below_min_confidence,
  };
  const path = address("/v1/scenes/{scene}/render", { scene: `${scene}@${scene_sha256}` });
  const answer = await request(path, {
    method: "POST",
    headers: { "Content-Type": "application/json", Accept: "application/dicom" },
    body: JSON.stringify(body),
  });
  return await answer.blob();
}
