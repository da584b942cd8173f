/** Sheets as files: a picture of one, a video of several. */

import { words } from "../../words/words.svelte";
import type { Page, Sheet } from "./sheet";

const VIDEO_TYPES = ["video/mp4;codecs=avc1.640028", "video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm"];
const BITS_PER_SECOND = 8e6;
const PIECE_MS = 200;
const LATE_MS = 5000; // a busy machine may take so long to encode its first picture

/** Throws where the browser cannot make a PNG of that size. */
export async function pngOf(sheet: Sheet, page: Page): Promise<Blob> {
  sheet.draw(page);
  const blob = await new Promise<Blob | null>((resolve) => sheet.canvas.toBlob(resolve, "image/png"));
  if (blob === null) throw new Error(words.scan.store.noPicture);
  return blob;
}

/** The type of video that this browser can record; undefined: none. */
export function videoType(): string | undefined {
  if (typeof MediaRecorder === "undefined" || !("captureStream" in HTMLCanvasElement.prototype)) return undefined;
  return VIDEO_TYPES.find((type) => MediaRecorder.isTypeSupported(type));
}

/** Pages one after another as a video, recorded as they are shown. Throws where the browser cannot record. */
export async function videoOf(
  sheet: Sheet,
  pages: readonly Page[],
  { perSecond, told }: { perSecond: number; told: (done: number) => void },
): Promise<{ blob: Blob; suffix: string }> {
  const mimeType = videoType();
  if (mimeType === undefined) throw new Error(words.scan.store.noVideo);
  sheet.draw(pages[0]!);
  const recorder = new MediaRecorder(sheet.canvas.captureStream(perSecond), { mimeType, videoBitsPerSecond: BITS_PER_SECOND });
  const parts: Blob[] = [];
  recorder.ondataavailable = ({ data }) => data.size > 0 && parts.push(data);
  recorder.start(PIECE_MS);
  await happened(recorder, "start");
  const began_ms = performance.now();
  for (const [index, page] of pages.entries()) {
    sheet.draw(page);
    told(index + 1);
    await pause(began_ms + ((index + 1) * 1000) / perSecond - performance.now());
  }
  for (let waited_ms = 0; parts.length === 0 && waited_ms < LATE_MS; waited_ms += PIECE_MS) {
    sheet.draw(pages.at(-1)!);
    await pause(PIECE_MS);
  }
  recorder.stop();
  await happened(recorder, "stop");
  if (parts.length === 0) throw new Error(words.scan.store.noVideo);
  return { blob: new Blob(parts, { type: mimeType }), suffix: mimeType.startsWith("video/mp4") ? "mp4" : "webm" };
}

function happened(recorder: MediaRecorder, type: "start" | "stop"): Promise<void> {
  return new Promise((resolve, reject) => {
    recorder.addEventListener(type, () => resolve(), { once: true });
    recorder.addEventListener("error", () => reject(new Error(words.scan.store.noVideo)), { once: true });
  });
}

function pause(for_ms: number): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, Math.max(0, for_ms)));
}
