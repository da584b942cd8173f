/** Confidence: said on the image in words, drawn where it is low, and told along the sweep before one goes there. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { canvasState, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { enterPose, IMAGE, openScan } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const at = tested();
const AWAY = '{"position_mm": {"x": 0, "y": 44, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}'; // the sweep ends at 36

/** The settings that the page sent last over its streams. */
function sentSettings(page) {
  const sent = [];
  page.on("websocket", (socket) =>
    socket.on("framesent", ({ payload }) => {
      const { settings } = JSON.parse(payload.toString());
      if (settings) sent.push(settings);
    }),
  );
  return () => sent.at(-1);
}

/** The share of the overlay's pixels that are drawn. */
function drawn(page) {
  return page.getByTestId("support-layer").evaluate((canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    for (let index = 3; index < data.length; index += 4) count += data[index] > 0 ? 1 : 0;
    return (4 * count) / data.length;
  });
}

describe("confidence", () => {
  it("stands in the corner of the image, in words and never as ±", async () => {
    const { page } = await openScan(at);
    const badge = page.getByTestId("confidence-badge");
    await until(() => badge.textContent(), (text) => /Well supported\s*expected similarity \d+ %, mean error \d+ percentage points/.test(text), "no badge");
    assert.equal(await page.getByTestId("confidence-frame").count(), 0);
    assert.match(await page.getByTestId("similarity").textContent(), /^\d+ %$/);
    assert.match(await page.getByTestId("similarity-error").textContent(), /^\d+ percentage points$/);
    assert.equal(await page.getByText("±").count(), 0);
  });

  it("puts a frame around a guess and hatches what nothing supports", async () => {
    const { page } = await openScan(at);
    await enterPose(page, AWAY);
    await page.getByTestId("confidence-frame").waitFor();
    await page.getByTestId("confidence-badge").getByText(/guess/i).waitFor();
    await page.getByTestId("confidence-badge").getByText(/training sweep/).waitFor();
    await page.getByTestId("support-layer").waitFor();
    await until(() => drawn(page), (share) => share > 0.05 && share < 0.3, "it is not hatched");
    await picture(page, "confidence-guess");
    assert.deepEqual(await seriousFindings(page), []);
    await page.getByLabel("Hatch where nothing supports it").uncheck();
    await page.getByTestId("support-layer").waitFor({ state: "detached" });
    assert.deepEqual(page.faults, []);
  });

  it("asks for coverage only while it is wanted", async () => {
    const page = await openPage(at, "");
    const last = sentSettings(page);
    await page.reload();
    await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    await enterPose(page, AWAY);
    await until(last, (settings) => settings?.outputs.includes("coverage"), "coverage is not asked for");
    await page.getByLabel("Hatch where nothing supports it").uncheck();
    await until(last, (settings) => settings.outputs.join() === "bmode", "coverage is still asked for");
  });

  it("colours pixels by their uncertainty, with a scale", async () => {
    const { page } = await openScan(at);
    const choice = page.getByLabel("Show uncertainty");
    const { outputs } = await (await fetch(`${at.service.url}/v1/scenes/demo`)).json();
    assert.equal(await choice.isEnabled(), outputs.includes("uncertainty"));
    if (!outputs.includes("uncertainty")) return;
    await choice.check();
    await page.getByTestId("uncertainty-scale").waitFor();
    await until(() => drawn(page), (share) => share > 0.3, "nothing is coloured");
    await picture(page, "confidence-uncertainty");
  });

  it("runs along the sweep under its slider, lower where the poses leave it", async () => {
    const { page } = await openScan(at);
    const strip = page.getByTestId("confidence-strip");
    await strip.waitFor();
    const label = await strip.getAttribute("aria-label");
    assert.match(label, /^Confidence along the poses: lowest \d+ % at \d+$/);
    const pose = (y) => ({ position_mm: { x: 0, y, z: 0 }, quaternion: { w: 1, x: 0, y: 0, z: 0 } });
    const leaving = [0, 10, 20, 30, 40, 50].map(pose);
    await page.getByLabel("File of poses").setInputFiles({ name: "leaving.json", mimeType: "application/json", buffer: Buffer.from(JSON.stringify(leaving)) });
    await until(() => strip.getAttribute("aria-label"), (text) => text !== null && text !== label && / at 6$/.test(text), "the strip did not follow");
    await page.locator('[data-testid="confidence-strip"] .bad[d^="M"]').waitFor({ state: "attached" });
    await page.locator('[data-testid="confidence-strip"] .good[d^="M"]').waitFor({ state: "attached" });
    await picture(page, "confidence-strip");
  });

  it("is drawn over a large image with fewer pixels than that has, so that it costs little", async () => {
    const { page } = await openScan(at);
    await page.getByRole("combobox", { name: "Image size" }).selectOption("512");
    await until(() => canvasState(page, IMAGE), ({ width }) => width === 512, "no 512 scan lines");
    await enterPose(page, AWAY);
    const layer = page.getByTestId("support-layer");
    await until(() => layer.evaluate(({ width, height }) => [width, height].join()), (size) => size === "256,256", "it has as many pixels as the image");
    await until(() => drawn(page), (share) => share > 0.05 && share < 0.3, "it is not hatched");
  });
});
