/** Maps: every output of one view side by side, with one cursor and the values that the service gives. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { canvasState, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { openScan } from "./scan_page.mjs";
import { built } from "./sources.mjs";
import { tested } from "./tested.mjs";

const SIDE = 256; // of the frames of the demo scene

let outputs;
let labels;
const at = tested({
  prepare: async ({ service }) => {
    const scene = await (await fetch(`${service.url}/v1/scenes/demo`)).json();
    outputs = scene.outputs;
    labels = { 0: "none", ...scene.label_names };
    assert.ok(outputs.includes("bmode") && outputs.includes("labels"), `${outputs}`);
  },
});

async function openMaps(options) {
  const page = await openPage(at, "#/maps/demo", options);
  for (const output of outputs)
    await until(() => canvasState(page, `[data-testid="map-${output}"]`), ({ width }) => width === SIDE, `no ${output}`);
  return page;
}

/** What the service renders at the pose that the page starts with: each output's uint8 pixels. */
async function rendered() {
  const { poses } = await (await fetch(`${at.service.url}/v1/scenes/demo/training-poses`)).json();
  const pose = poses[Math.floor(poses.length / 2)];
  const matrix = [0, 4, 8, 12].map((start) => pose.slice(start, start + 4));
  const answer = await fetch(`${at.service.url}/v1/scenes/demo/render`, {
    method: "POST",
    headers: { "Content-Type": "application/json", Accept: "application/octet-stream;dtype=uint8" },
    body: JSON.stringify({ pose: { matrix }, outputs }),
  });
  const pixels = new Uint8Array(await answer.arrayBuffer());
  return Object.fromEntries(outputs.map((output, i) => [output, pixels.subarray(i * SIDE * SIDE, (i + 1) * SIDE * SIDE)]));
}

describe("maps", () => {
  it("shows the values of all outputs where the cursor is", async () => {
    const page = await openMaps();
    const expected = await rendered();
    const box = await page.locator('[data-testid="map-echo"] canvas').boundingBox();
    for (const [column, row] of [[128, 40], [200, 128], [60, 180]]) {
      await page.mouse.move(box.x + ((column + 0.5) / SIDE) * box.width, box.y + ((row + 0.5) / SIDE) * box.height);
      await page.getByText(`${column}, ${row}`).waitFor();
      for (const output of outputs) {
        const value = expected[output][row * SIDE + column];
        const written = output === "labels" ? labels[value] : (value / 255).toFixed(3);
        assert.equal(await page.getByTestId(`value-${output}`).textContent(), written, `${output} at ${column}, ${row}`);
      }
    }
    assert.equal(await page.getByTestId("cursor-lateral").textContent(), "-15.82 mm"); // (60.5 / 256 - 1/2) 60 mm
    assert.equal(await page.locator('[data-testid^="map-"] svg.overlay rect').count(), outputs.length);
    await picture(page, "maps");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("is worked by keyboard, and readers of the screen find their way", async () => {
    const page = await openMaps({ width: 1024, height: 768 });
    await page.getByLabel("Maps; the arrow keys move the cursor").focus();
    await page.keyboard.press("ArrowRight");
    await page.keyboard.press("Shift+ArrowDown");
    await page.getByText(`${SIDE / 2 + 1}, ${SIDE / 2 + 10}`).waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    const names = page.locator('[data-testid^="map-"] header button');
    const cut = await names.evaluateAll((all) => all.filter((one) => one.scrollWidth > one.clientWidth).map((one) => one.textContent));
    assert.deepEqual(cut, [], "names of maps are cut");
    await picture(page, "maps-1024");
  });

  it("shows B-mode as the product of its neighbours whatever gain Scan has, and nothing beside a fan", async () => {
    const { page } = await openScan(at); // a probe that is chosen before the scene is known is not kept
    await page.getByLabel("Gain", { exact: true }).fill("12");
    await page.getByRole("combobox", { name: "Probe" }).selectOption("convex");
    await page.getByRole("link", { name: "Maps", exact: true }).click();
    const bmode = '[data-testid="map-bmode"]';
    await until(() => canvasState(page, bmode), ({ width, mean }) => width === 640 && mean > 5, "no fan came");
    const box = await page.locator(`${bmode} canvas`).boundingBox();
    const value = async (output) => Number(await page.getByTestId(`value-${output}`).textContent());
    for (const depth of [0.2, 0.4, 0.6]) {
      await page.mouse.move(box.x + box.width / 2, box.y + box.height * depth);
      await until(() => value("bmode"), (shown) => !Number.isNaN(shown), "no value");
      const product = (await value("echo")) * (await value("transmittance"));
      assert.ok(Math.abs((await value("bmode")) - product) < 0.01, `${await value("bmode")} is not ${product}`);
    }
    await page.mouse.move(box.x + 3, box.y + 3);
    for (const output of outputs)
      await until(() => page.getByTestId(`value-${output}`).textContent(), (text) => text === "–", `${output} beside the fan`);
  });

  it("follows the sweep, and keeps the view of Scan", async () => {
    const page = await openMaps();
    const first = await canvasState(page, '[data-testid="map-bmode"]');
    await page.getByLabel("Place in the training sweep").fill("10");
    await until(() => canvasState(page, '[data-testid="map-bmode"]'), ({ print }) => print !== first.print, "it stood still");
    await page.getByRole("link", { name: "Scan", exact: true }).click();
    await page.getByText("view 11 of").waitFor();
  });

  it("keeps the large map, the cursor and the pose in the address and over other views", async () => {
    const page = await openMaps();
    await page.getByRole("button", { name: "Coverage, show large" }).click();
    await page.getByRole("heading", { name: "Coverage" }).waitFor();
    const box = await page.locator('[data-testid="map-coverage"] canvas').boundingBox();
    assert.ok(box.width > 400, `the large map is ${box.width} px wide`);
    await page.mouse.move(box.x + (60.5 / SIDE) * box.width, box.y + (180.5 / SIDE) * box.height);
    await page.getByText("60, 180").waitFor();
    await page.getByLabel("Place in the training sweep").fill("10");
    await page.getByText("view 11 of").waitFor();
    const value = await page.getByTestId("value-echo").textContent();
    await until(() => page.url(), (url) => /map=coverage/.test(url) && /cursor=-15\.82_/.test(url) && /pose=/.test(url), "the address tells less");
    await page.getByRole("link", { name: "Scan", exact: true }).click();
    await page.getByRole("link", { name: "Maps", exact: true }).click();
    await page.getByRole("heading", { name: "Coverage" }).waitFor();
    await page.getByText("60, 180").waitFor();
    await until(() => page.url(), (url) => /map=coverage/.test(url), "the address forgot");
    await page.reload();
    await page.getByRole("heading", { name: "Coverage" }).waitFor();
    await page.getByText("60, 180").waitFor();
    await until(() => page.getByTestId("place").innerText(), (text) => text !== "view 106 of 211", "the pose is lost");
    assert.ok(value.length > 1);
    assert.deepEqual(page.faults, []);
  });

  it("shows nothing beside a fan, told from a value of 0 by hatching", async () => {
    const { page } = await openScan(at);
    await page.getByRole("combobox", { name: "Probe" }).selectOption("convex");
    await page.getByRole("link", { name: "Maps", exact: true }).click();
    await page.getByRole("button", { name: "Coverage, show large" }).click();
    const map = '[data-testid="map-coverage"]';
    await until(() => canvasState(page, map), ({ width, mean }) => width === 640 && mean > 5, "no fan came");
    await picture(page, "maps-fan");
    const box = await page.locator(`${map} canvas`).boundingBox();
    const shot = await page.screenshot({ clip: { x: box.x + 4, y: box.y + 4, width: 24, height: 24 } });
    const colours = await page.evaluate(async (bytes) => {
      const bitmap = await createImageBitmap(new Blob([new Uint8Array(bytes)]));
      const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
      context.drawImage(bitmap, 0, 0);
      const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
      return new Set(Array.from({ length: data.length / 4 }, (_, i) => data.slice(4 * i, 4 * i + 3).join())).size;
    }, [...shot]);
    assert.ok(colours >= 2, "the corner beside the fan is of one colour, as a value would be");
  });
});

describe("the colours of maps", () => {
  it("grow lighter all the way, so that grey is enough to read them", async () => {
    const { shareColour } = await built("shared/colours");
    for (const output of outputs.filter((one) => one !== "labels")) {
      const grey = Array.from({ length: 33 }, (_, i) => shareColour(output, i / 32)).map(([r, g, b]) => 0.2126 * r + 0.7152 * g + 0.0722 * b);
      grey.slice(1).forEach((value, i) => assert.ok(value > grey[i] + 0.5, `${output} is not lighter at ${i + 1} of 32`));
    }
  });
});
