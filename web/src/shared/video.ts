/** Videos, as far as the browser can record them. */

import { words } from "../words/words.svelte";

const VIDEO_TYPES = ["video/mp4;codecs=avc1.640028", "video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm"];
const BITS_PER_SECOND = 8e6;
const PIECE_MS = 200;
const LATE_MS = 5000; // a busy machine may take so long to encode its first picture

/** The type of video that this browser can record; undefined: none. */
export function videoType(): string | undefined {
  if (typeof MediaRecorder === "undefined" || !("captureStream" in HTMLCanvasElement.prototype)) return undefined;
  return VIDEO_TYPES.find((type) => MediaRecorder.isTypeSupported(type));
}

/** Pictures one after another as a video, recorded from a canvas as they are drawn on it. Throws where the browser cannot record. */
export async function videoOf(
  canvas: HTMLCanvasElement,
  count: number,
  { draw, perSecond, told }: { draw: (index: number) => void | Promise<void>; perSecond: number; told: (done: number) => void },
): Promise<{ blob: Blob; suffix: string }> {
  const mimeType = videoType();
  if (mimeType === undefined) throw new Error(words.shared.noVideo);
  await draw(0);
  const recorder = new MediaRecorder(canvas.captureStream(perSecond), { mimeType, videoBitsPerSecond: BITS_PER_SECOND });
  const parts: Blob[] = [];
  recorder.ondataavailable = ({ data }) => data.size > 0 && parts.push(data);
  recorder.start(PIECE_MS);
  await happened(recorder, "start");
  const began_ms = performance.now();
  for (let index = 0; index < count; index++) {
    await draw(index);
    told(index + 1);
    await pause(began_ms + ((index + 1) * 1000) / perSecond - performance.now());
  }
  for (let waited_ms = 0; parts.length === 0 && waited_ms < LATE_MS; waited_ms += PIECE_MS) {
    await draw(count - 1);
    await pause(PIECE_MS);
  }
  recorder.stop();
  await happened(recorder, "stop");
  if (parts.length === 0) throw new Error(words.shared.noVideo);
  return { blob: new Blob(parts, { type: mimeType }), suffix: mimeType.startsWith("video/mp4") ? "mp4" : "webm" };
}

function happened(recorder: MediaRecorder, type: "start" | "stop"): Promise<void> {
  return new Promise((resolve, reject) => {
    recorder.addEventListener(type, () => resolve(), { once: true });
    recorder.addEventListener("error", () => reject(new Error(words.shared.noVideo)), { once: true });
  });
}

function pause(for_ms: number): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, Math.max(0, for_ms)));
}
