/** Compare: held-out frames beside what the scene and the classical way make of them. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { describe, it } from "node:test";

import { hold, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { put } from "./sweep.mjs";
import { tested } from "./tested.mjs";

const HELD_OUT = 5;

const at = tested({
  sweep: true,
  prepare: async ({ service, files }) => {
    await put(service, "/v1/datasets/sweep", readFileSync(files.sweep), "application/zip");
    await put(service, "/v1/scenes/compared", readFileSync(files.compared), "application/octet-stream");
  },
});

/** Bytes of a picture as the page shows it. */
function shown(page, name) {
  return page.getByRole("region", { name, exact: true }).locator("img").evaluate(async (image) => {
    await image.decode();
    const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0);
    return [...context.getImageData(0, 0, canvas.width, canvas.height).data].filter((_, i) => i % 4 === 0);
  });
}

const rms = (a, b) => Math.sqrt(a.reduce((sum, value, i) => sum + (value - b[i]) ** 2, 0) / a.length);

describe("compare", () => {
  it("computes the comparison, then steps through the frames with their metrics", async () => {
    const page = await openPage(at, "#/compare/compared");
    await page.getByTestId("comparison").waitFor();
    const { frames } = await (await fetch(`${at.service.url}/v1/scenes/compared/comparison`)).json();
    assert.equal(frames.length, HELD_OUT);
    const row = page.getByRole("row", { name: /^PSNR/ });
    await until(() => row.textContent(), (text) => text.includes(frames[0].psnr_db.toFixed(2)), "not its PSNR");
    assert.ok((await row.textContent()).includes(frames[0].median_psnr_db.toFixed(2)));

    const [truth, rendering, median] = [await shown(page, "Truth"), await shown(page, "Rendering"), await shown(page, "Median compounding")];
    assert.ok(rms(truth, rendering) < rms(truth, median), "the scene that made the frames is not nearer to them");

    await page.keyboard.press("ArrowRight");
    await until(() => page.getByTestId("frame-number").textContent(), (text) => text === `Frame ${frames[1].frame_number}`, "no step");
    await until(() => row.textContent(), (text) => text.includes(frames[1].psnr_db.toFixed(2)), "the metrics stood still");
    await until(() => shown(page, "Truth"), (now) => rms(now, truth) > 1, "the picture stood still");
    await page.getByLabel("Frame", { exact: true }).fill(String(HELD_OUT - 1));
    await until(() => page.getByTestId("frame-number").textContent(), (text) => text === `Frame ${frames.at(-1).frame_number}`, "no jump");
    assert.equal(await page.getByRole("button", { name: "Next frame" }).isDisabled(), true);

    await page.getByRole("button", { name: "GMSD" }).click();
    const chart = page.getByRole("img", { name: /^GMSD over/ });
    const box = await chart.boundingBox();
    await page.mouse.click(box.x + 50, box.y + 60); // at its left end
    await until(() => page.getByTestId("frame-number").textContent(), (text) => text === `Frame ${frames[0].frame_number}`, "no pick");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
    await picture(page, "compare");
  });

  it("tells a picture that is late or did not come, and gets it", async () => {
    const page = await openPage(at, "#/compare/compared");
    const truth = page.getByRole("region", { name: "Truth", exact: true });
    await truth.locator('img[aria-busy="false"]').waitFor();
    const release = await hold(page, /comparison\/1\/truth\.png$/);
    await page.getByRole("button", { name: "Next frame" }).click();
    await until(() => truth.locator('img[aria-busy="true"]').evaluate((image) => Number(getComputedStyle(image).opacity)), (opacity) => opacity < 0.5, "the picture before looks like the new one");
    release();
    await until(() => truth.locator('img[aria-busy="false"]').evaluate((image) => getComputedStyle(image).opacity), (opacity) => opacity === "1", "it is not shown");

    let down = true;
    await page.route(/comparison\/2\/truth\.png$/, (route) => (down ? route.abort() : route.continue()));
    await page.getByRole("button", { name: "Next frame" }).click();
    await truth.getByText("The service does not answer.").waitFor();
    down = false;
    await truth.locator('img[aria-busy="false"]').waitFor();
  });

  it("can be asked again after it failed", async () => {
    const page = await openPage(at, "#/scenes");
    let failing = true;
    const failed = { state: "failed", progress: 0, dataset: "sweep", frames: [], reason: "there was not enough memory" };
    await page.route(/\/comparison$/, (route) => (failing ? route.fulfill({ json: failed }) : route.continue()));
    await page.goto(`${at.service.url}/#/compare/compared`);
    await page.getByRole("alert").getByText("there was not enough memory").waitFor();
    const failedAgain = page.waitForResponse(/\/comparison$/);
    await page.getByRole("button", { name: "Try again" }).click();
    await failedAgain;
    await page.getByRole("alert").getByText("there was not enough memory").waitFor();
    failing = false;
    await page.getByRole("button", { name: "Try again" }).click();
    await page.getByTestId("comparison").waitFor();
  });

  it("is usable by readers of the screen and on a tablet", async () => {
    for (const [width, height, scheme] of [[1280, 800, "dark"], [820, 1180, "light"]]) {
      const page = await openPage(at, "#/compare/compared", { width, height, scheme });
      await page.getByRole("region", { name: "Truth", exact: true }).locator("img").waitFor();
      assert.deepEqual(await seriousFindings(page), []);
      await picture(page, `compare-${width}`);
      await page.context().close();
    }
  });

  it("says what is missing where the service has not the scene's dataset", async () => {
    const page = await openPage(at, "#/compare/demo");
    await page.getByRole("alert").getByText("is not among those of the service").waitFor();
    await page.getByText("Upload the same sweep").waitFor();
    await picture(page, "compare-without-dataset");
  });
});
