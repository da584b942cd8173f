/** Labels for a scene: painted on a frame, spread by the service, corrected in the next frame, saved as a scene. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { BACKGROUND_TIMEOUT_MS, canvasState, picture, seriousFindings } from "./harness.mjs";
import { cut, small } from "./reach.mjs";
import { changed, enterPose, IMAGE, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const at = tested();
const panelOf = (page) => page.getByRole("region", { name: "Labels" });
const LESION = 5; // beside the four labels of the demo scene

async function openLabels(options) {
  const { page } = await openScan(at, options);
  await page.getByRole("button", { name: "Labels: show or hide" }).click();
  await panelOf(page).getByRole("button", { name: "Paint on this frame" }).click();
  await page.getByTestId("paint-layer").waitFor();
  return page;
}

async function addLesion(page) {
  await panelOf(page).getByRole("button", { name: "Another label" }).click();
  await page.getByLabel(`Name of label ${LESION}`).fill("lesion");
  await page.keyboard.press("Tab");
}

/** Shares of the width and height of the picture as a place on the screen. */
async function placeOf(page, x, y) {
  const box = await page.getByTestId("paint").boundingBox();
  return [box.x + box.width * x, box.y + box.height * y];
}

async function draw(page, from, to) {
  await page.mouse.move(...(await placeOf(page, ...from)));
  await page.mouse.down();
  await page.mouse.move(...(await placeOf(page, ...to)), { steps: 6 });
  await page.mouse.up();
}

/** How many pixels of the layer have paint, or the label that the scene has there. */
const inked = (page) =>
  page.getByTestId("paint").evaluate((canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return data.filter((value, index) => index % 4 === 3 && value > 120).length;
  });

async function spread(page, button = "Spread") {
  await panelOf(page).getByRole("button", { name: button, exact: true }).click();
}

const saved = (page, text) => page.getByTestId("label-state").getByText(text).waitFor({ timeout: BACKGROUND_TIMEOUT_MS });

/** The label that most pixels have where the tests paint: a Gaussian here and there may say otherwise. */
async function labelOf(scene, pose) {
  const answer = await fetch(`${at.service.url}/v1/scenes/${scene}/render`, {
    method: "POST",
    headers: { "Content-Type": "application/json", Accept: "application/octet-stream" },
    body: JSON.stringify({ pose, outputs: ["labels"], height: 100, width: 100 }),
  });
  assert.equal(answer.status, 200);
  const labels = new Uint8Array(await answer.arrayBuffer());
  const counts = new Map();
  for (let row = 27; row < 34; row++)
    for (let column = 31; column < 40; column++) {
      const label = labels[100 * row + column];
      counts.set(label, (counts.get(label) ?? 0) + 1);
    }
  return [...counts].sort((a, b) => b[1] - a[1])[0][0];
}

const scene = async (name) => (await fetch(`${at.service.url}/v1/scenes/${name}`)).json();

describe("labels of a scene", () => {
  it("are painted, spread, corrected in the next frame, and saved", async () => {
    const page = await openLabels();
    const first = await poseOf(page);
    await addLesion(page);
    await page.getByLabel("Diameter of the brush, mm", { exact: true }).fill("10");
    await draw(page, [0.3, 0.3], [0.4, 0.3]);
    assert.ok((await inked(page)) > 500);
    await picture(page, "labels-painted");
    assert.deepEqual(await seriousFindings(page), []);
    await spread(page);
    await saved(page, "One frame painted, saved as demo-labelled.");
    await picture(page, "labels-spread");
    assert.equal((await scene("demo-labelled")).label_names[LESION], "lesion");
    assert.equal((await scene("demo")).label_names[LESION], undefined);
    assert.equal(await labelOf("demo-labelled", first), LESION);
    assert.equal(await labelOf("demo", first), 2);

    await panelOf(page).getByRole("button", { name: "Next frame" }).click();
    const { print } = await canvasState(page, IMAGE);
    await enterPose(page, JSON.stringify({ ...first, position_mm: { ...first.position_mm, y: first.position_mm.y + 3 } }));
    await changed(page, print);
    await panelOf(page).getByRole("button", { name: "Paint on this frame" }).click();
    await page.getByTestId("paint-layer").waitFor();
    const second = await poseOf(page);
    assert.ok(Math.abs(second.position_mm.y - first.position_mm.y - 3) < 0.01);
    await page.getByLabel("Paint with muscle").check();
    await draw(page, [0.3, 0.3], [0.4, 0.3]);
    await spread(page);
    await saved(page, "2 frames painted, saved as demo-labelled.");
    assert.equal(await labelOf("demo-labelled", second), 2);
    assert.equal(await labelOf("demo-labelled", first), LESION);

    await spread(page, "Take back");
    await saved(page, "One frame painted, saved as demo-labelled.");
    await page.getByRole("link", { name: "Open demo-labelled" }).click();
    await page.getByText("demo-labelled · Live").first().waitFor();
    assert.deepEqual([page.faults, page.foreign], [[], []]);
    await fetch(`${at.service.url}/v1/scenes/demo-labelled`, { method: "DELETE" });
  });

  it("cover a region, are erased and undone, and are painted by keys", async () => {
    const page = await openLabels();
    await addLesion(page);
    await panelOf(page).getByRole("button", { name: "Region" }).click();
    await page.getByLabel("Grey levels that a region may differ", { exact: false }).first().fill("60");
    await page.mouse.click(...(await placeOf(page, 0.35, 0.3)));
    const region = await inked(page);
    assert.ok(region > 200, `${region}`);
    await picture(page, "labels-region");
    await panelOf(page).getByRole("button", { name: "Eraser" }).click();
    await draw(page, [0.35, 0.3], [0.35, 0.32]);
    const erased = await inked(page);
    assert.ok(erased < region);
    await panelOf(page).getByRole("button", { name: "Undo stroke" }).click();
    assert.equal(await inked(page), region);
    await panelOf(page).getByRole("button", { name: "Undo stroke" }).click();
    assert.equal(await inked(page), 0);
    await panelOf(page).getByRole("button", { name: "Brush" }).click();
    await page.getByTestId("paint-layer").focus();
    await page.keyboard.press("ArrowLeft");
    await page.keyboard.press("Enter");
    assert.ok((await inked(page)) > 50);
    await page.keyboard.press("Control+z");
    assert.equal(await inked(page), 0);
    assert.deepEqual(page.faults, []);
  });

  it("have room for fingers on a phone, and are painted with them", async () => {
    const page = await openLabels({ width: 390, height: 844, touch: true });
    await page.getByTestId("paint").scrollIntoViewIfNeeded();
    await page.touchscreen.tap(...(await placeOf(page, 0.4, 0.4)));
    assert.ok((await inked(page)) > 50);
    await picture(page, "labels-phone-image");
    await panelOf(page).scrollIntoViewIfNeeded();
    await picture(page, "labels-phone");
    assert.deepEqual(await small(page, 44), []);
    assert.deepEqual(await cut(page), []);
    assert.deepEqual(await seriousFindings(page), []);
    assert.deepEqual(page.faults, []);
  });
});
