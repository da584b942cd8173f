/** The 3D view: what it holds on the graphics card, the image in its plane, the probe that is turned. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { canvasState, picture, until } from "./harness.mjs";
import { dragProbe, IMAGE, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const CONVEX_RADIUS_MM = 40;
const PLANE_NUMBERS = 65 * 2 * 3; // x, y, z of both ends of the scan lines of a plane

const at = tested();

/** Counts the buffers on the graphics card, and notes how deep the planes go that are put there. */
function watchGraphics(planeNumbers) {
  globalThis.buffers = 0;
  globalThis.depths = [];
  const { createBuffer, deleteBuffer, bufferData } = WebGL2RenderingContext.prototype;
  WebGL2RenderingContext.prototype.createBuffer = function () {
    globalThis.buffers += 1;
    return createBuffer.call(this);
  };
  WebGL2RenderingContext.prototype.deleteBuffer = function (buffer) {
    if (buffer) globalThis.buffers -= 1;
    return deleteBuffer.call(this, buffer);
  };
  WebGL2RenderingContext.prototype.bufferData = function (...given) {
    if (given[1] instanceof Float32Array && given[1].length === planeNumbers)
      globalThis.depths.push(Math.max(...given[1].filter((_, i) => i % 3 === 2)));
    return bufferData.apply(this, given);
  };
}

async function openSpace() {
  const { page } = await openScan(at, { init: `(${watchGraphics})(${PLANE_NUMBERS})` });
  const room = page.getByTestId("room");
  await room.locator("canvas").waitFor();
  await steadyBuffers(page);
  return { page, room };
}

/** The number of buffers once it stands still for so many tenths of a second. */
async function steadyBuffers(page, tenths = 5) {
  let before = -1;
  let same = 0;
  const stands = (count) => {
    same = count > 8 && count === before ? same + 1 : 0;
    before = count;
    return same >= tenths;
  };
  return until(() => page.evaluate(() => globalThis.buffers), stands, "the 3D view does not come to rest");
}

describe("the scene in space", () => {
  it("keeps nothing of probes that were changed, nor of itself when it is left", async () => {
    const { page } = await openSpace();
    const probe = page.getByRole("combobox", { name: "Probe" });
    const kinds = (await probe.locator("option").evaluateAll((options) => options.map(({ value }) => value))).reverse();
    const choose = async (kind) => {
      await probe.selectOption(kind);
      await until(() => probe.inputValue(), (value) => value === kind, kind);
      return steadyBuffers(page, 20); // what is drawn slowly is put there late
    };
    const counts = [];
    for (const kind of [...kinds, ...kinds, ...kinds]) counts.push(await choose(kind));
    const earlier = counts.splice(0, 2 * kinds.length); // parts are put there when they are first drawn
    assert.ok(Math.max(...counts) <= Math.max(...earlier), `${earlier} buffers, then ${counts}`);
    await page.getByRole("link", { name: "Train", exact: true }).click();
    await until(() => page.evaluate(() => globalThis.buffers), (count) => count <= 2, "buffers stay");
  });

  it("ends the image in its plane where the depth cuts it", async () => {
    const { page } = await openSpace();
    const deepest = (depth_mm) =>
      until(
        () => page.evaluate(() => globalThis.depths),
        (depths) => depths.some((depth) => Math.abs(depth - depth_mm) < 0.5),
        `no plane that is ${depth_mm} mm deep`,
      );
    await deepest(60);
    await page.getByLabel("Depth", { exact: true }).fill("30");
    await deepest(30);
  });

  it("has a picture, a plane and a ruler for every kind of probe, as a sector and as scan lines", async () => {
    const { page } = await openScan(at);
    const probe = page.getByRole("combobox", { name: "Probe" });
    const kinds = await probe.locator("option").evaluateAll((options) => options.map(({ value }) => value));
    assert.ok(kinds.length >= 4, `${kinds}`);
    for (const kind of kinds.filter((one) => one !== "own")) {
      const { print } = await canvasState(page, IMAGE);
      await probe.selectOption(kind);
      await until(() => canvasState(page, IMAGE), (state) => state.print !== print && state.mean > 1, `no ${kind} image`);
      await page.getByTestId("depth-ruler").getByText("1", { exact: true }).first().waitFor();
      await picture(page, `scan-${kind}`);
      const stored = page.getByRole("button", { name: "Scan lines" });
      if ((await stored.count()) === 0) continue;
      await stored.click();
      await until(() => canvasState(page, IMAGE), ({ width }) => width === 256, `no scan lines of ${kind}`);
      await picture(page, `scan-${kind}-lines`);
      await page.getByRole("button", { name: "Sector" }).click();
    }
    assert.deepEqual(page.faults, []);
  });

  it("is drawn again after the graphics card was lost", async () => {
    const { page, room } = await openSpace();
    const canvas = room.locator("canvas");
    await canvas.evaluate((element) => {
      const context = element.getContext("webgl2");
      const { fenceSync } = WebGL2RenderingContext.prototype;
      const loss = context.getExtension("WEBGL_lose_context");
      globalThis.restored = new Promise((resolve) => {
        element.addEventListener("webglcontextlost", () => setTimeout(() => loss.restoreContext()));
        element.addEventListener("webglcontextrestored", resolve);
      });
      context.fenceSync = (...given) => {
        delete context.fenceSync;
        const fence = fenceSync.apply(context, given);
        loss.loseContext(); // while the drawing is waited for
        return fence;
      };
    });
    await page.getByRole("button", { name: "Options" }).click();
    await page.getByLabel("Cut", { exact: true }).selectOption("image");
    await page.evaluate(() => globalThis.restored);
    const drawn = async () => (await canvas.screenshot()).toString("base64");
    const before = await drawn();
    await page.getByLabel("Sweep", { exact: true }).check();
    await until(async () => (await drawn()) !== before, Boolean, "the view stays as it was");
  });

  it("turns a convex probe about the middle of its face", async () => {
    const { page, room } = await openSpace();
    await page.getByRole("combobox", { name: "Probe" }).selectOption("convex");
    await until(() => poseOf(page), ({ position_mm }) => position_mm.z < -30, "the face of the convex probe left the skin");
    await page.getByRole("button", { name: "Turn", exact: true }).click();
    await steadyBuffers(page);
    const pose = await poseOf(page);
    assert.ok(await dragProbe(page, room, pose), "there is no handle where the probe is");
    const [face, turned] = [faceOf(pose), faceOf(await poseOf(page))];
    const away_mm = Math.hypot(...face.map((value, i) => value - turned[i]));
    assert.ok(away_mm < 0.05, `the face moved by ${away_mm} mm`);
    await picture(page, "scan-turned");
  });
});

/** Where the middle of the face of the convex probe lies, mm. */
function faceOf({ position_mm: p, quaternion: { w, x, y, z } }) {
  const axial = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
  return [p.x, p.y, p.z].map((value, i) => value + CONVEX_RADIUS_MM * axial[i]);
}
