/** The Scan view as the tests use it. */

import { canvasState, openPage, until } from "./harness.mjs";

export const IMAGE = '[aria-label="Live image"]';

/** Opens Scan on a scene and waits for its image; `first` is its state. */
export async function openScan(at, { scene = "demo", ...options } = {}) {
  const page = await openPage(at, `#/scan/${scene}`, options);
  const first = await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
  return { page, first };
}

export function changed(page, print) {
  return until(() => canvasState(page, IMAGE), (state) => state.print !== print, "the image did not change");
}

export async function poseOf(page) {
  return JSON.parse(await page.getByLabel("Pose as JSON, Enter applies").inputValue());
}

/** Applies a text as the pose. */
export async function enterPose(page, text) {
  await page.getByLabel("Pose as JSON, Enter applies").fill(text);
  await page.keyboard.press("Enter");
}

/** Drags the probe by a handle, which the pointer tells by its shape, until the pose follows; false without a handle.
 *
 * `read`: what follows in place of the pose.
 */
export async function dragProbe(page, room, pose, read = poseOf) {
  const box = await room.boundingBox();
  for (let y = 0.25; y < 0.6; y += 0.015) {
    for (let x = 0.45; x < 0.75; x += 0.015) {
      await page.mouse.move(box.x + box.width * x, box.y + box.height * y);
      if ((await room.locator("canvas").evaluate((canvas) => canvas.style.cursor)) !== "grab") continue;
      await page.mouse.down();
      await page.mouse.move(box.x + box.width * x + 30, box.y + box.height * y + 40, { steps: 4 });
      await page.mouse.up();
      const moved = (now) => JSON.stringify(now) !== JSON.stringify(pose);
      await until(() => read(page), moved, "the probe did not follow the pointer");
      return true;
    }
  }
  return false;
}
