/** What other programs do with a scene: the streams that they have open, and the data sets and films that a path becomes. */

import { untilAnswered } from "../api/client";
import { startJob } from "../api/jobs";
import { renderPicture } from "../api/rendering";
import { listStreams, PAGE, PAGE_NAME, type StreamSummary } from "../api/stream";
import type { Pose } from "../geometry/pose";
import { service } from "../page/service.svelte";
import type { Session } from "../session/session.svelte";
import { base64, polled } from "../shared/asking.svelte";
import { videoOf } from "../shared/video";

const EVERY_MS = 1000;

/** The streams that other programs have open on a scene, looked for every second. */
export class OpenStreams {
  /** null: not known yet. */
  others = $state.raw<StreamSummary[] | null>(null);

  /** Must be made while a component is being made. `wanted`: whether anybody looks. */
  constructor(scene: () => string, wanted: () => boolean) {
    $effect(() => {
      if (service.status !== "ready" || !wanted()) return;
      const take = (all: StreamSummary[]): void => void (this.others = all.filter(({ name }) => name !== PAGE_NAME + PAGE));
      const of = scene();
      return polled((signal) => listStreams(of, signal), EVERY_MS, take, () => undefined);
    });
  }
}

/** Has the service render poses with the image settings of a session; the id of the job. */
export async function renderPath(session: Session, poses: readonly Pose[], format: string): Promise<string> {
  const written = base64(new Uint8Array(new Float64Array(poses.flat()).buffer)); // row by row, the low byte first
  return (await startJob("render", { scene: session.name, poses: written, format, ...session.settings(["bmode"]) }, false)).id;
}

const MOST_FILMED = 1800; // of longer paths an even selection
const FILMED_PER_SECOND = 30;

/** Poses as a film, with the image settings of a session; `told` hears how many frames are rendered. Throws ServiceError, Unreachable. */
export async function filmOf(
  session: Session,
  poses: readonly Pose[],
  told: (done: number, all: number) => void,
  signal: AbortSignal,
): Promise<{ blob: Blob; suffix: string }> {
  const count = Math.min(MOST_FILMED, poses.length);
  const settings = session.settings(["bmode"]);
  const frames: Blob[] = [];
  for (let index = 0; index < count; index++) {
    const pose = poses[Math.round((index * (poses.length - 1)) / Math.max(1, count - 1))]!;
    frames.push((await untilAnswered(() => renderPicture(session.name, pose, settings, signal), () => undefined, signal)).picture);
    told(index + 1, count);
  }
  const canvas = document.createElement("canvas");
  const draw = async (index: number): Promise<void> => {
    const picture = await createImageBitmap(frames[index]!);
    // encoders want even sides
    if (index === 0) [canvas.width, canvas.height] = [2 * Math.ceil(picture.width / 2), 2 * Math.ceil(picture.height / 2)];
    canvas.getContext("2d")!.drawImage(picture, 0, 0);
    picture.close();
  };
  return videoOf(canvas, count, { draw, perSecond: FILMED_PER_SECOND, told: () => undefined });
}
