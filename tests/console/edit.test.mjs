/** Edit: bodies put into the image and sized, cuts, what is made of them, and the way back to the parents. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { BACKGROUND_TIMEOUT_MS, picture, seriousFindings, until } from "./harness.mjs";
import { cut, small } from "./reach.mjs";
import { dragProbe, IMAGE, openScan } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const at = tested();
const panelOf = (page) => page.getByRole("region", { name: "Edit", exact: true });
const button = (page, name) => panelOf(page).getByRole("button", { name, exact: true });
const PLACE = [0.4, 0.45]; // of what is put in, as shares of the picture
const scene = async (name) => (await fetch(`${at.service.url}/v1/scenes/${name}`)).json();

async function openEdit(options) {
  const { page } = await openScan(at, options);
  await page.getByRole("button", { name: "Edit: show or hide" }).click();
  await button(page, "+ Insert").waitFor();
  return page;
}

async function screenAt(page, [across, down]) {
  const box = await page.locator(`${IMAGE} canvas`).first().boundingBox();
  return [box.x + box.width * across, box.y + box.height * down];
}

/** The mean grey within some pixels of a place of the picture. */
function greyAt(page, [across, down]) {
  return page.locator(`${IMAGE} canvas`).first().evaluate((canvas, [across, down]) => {
    const [x, y] = [Math.round(canvas.width * across), Math.round(canvas.height * down)];
    const { data } = canvas.getContext("2d").getImageData(x - 3, y - 3, 7, 7);
    return data.reduce((sum, value, index) => sum + (index % 4 === 0 ? value : 0), 0) / 49;
  }, [across, down]);
}

const centreOf = (page) => Promise.all(["X", "Y", "Z"].map(async (axis) => Number(await page.getByLabel(`Centre ${axis}, mm`).inputValue())));

async function save(page, name) {
  await panelOf(page).getByLabel("New scene").fill(name);
  await button(page, "Save as a new scene").click();
  await page.getByText(`${name} · Live`).first().waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
}

describe("edits of a scene", () => {
  it("put a cyst where the image is pressed, which darkens it; the parent undoes it, and a cut is made of that", async () => {
    const page = await openEdit();
    const before = await greyAt(page, PLACE);
    await button(page, "+ Insert").click();
    await panelOf(page).getByRole("combobox", { name: "Tissue" }).selectOption("cyst");
    await page.mouse.click(...(await screenAt(page, PLACE)));
    const outline = await page.getByTestId("outline").boundingBox();
    const [x, y] = await screenAt(page, PLACE);
    assert.ok(Math.hypot(outline.x + outline.width / 2 - x, outline.y + outline.height / 2 - y) < 3, JSON.stringify([outline, x, y]));
    await picture(page, "edit-insert");
    assert.deepEqual(await seriousFindings(page), []);

    await save(page, "with-cyst");
    await until(() => greyAt(page, PLACE), (grey) => grey < before / 2, "the image is as bright as before");
    assert.deepEqual(Object.keys((await scene("with-cyst")).parents), ["demo"]);
    await picture(page, "edit-made");

    await page.getByTestId("parents").getByRole("link", { name: "demo" }).click();
    await until(() => greyAt(page, PLACE), (grey) => Math.abs(grey - before) < 2, "the parent is not as it was");
    const listed = panelOf(page).getByRole("list", { name: "Edits, in their order" });
    await listed.getByRole("button", { name: "1 Insert: cyst" }).waitFor();
    while (await listed.isVisible()) await button(page, "Undo").click();
    await button(page, "Redo").click();
    await listed.getByRole("button", { name: /^1 Insert/ }).waitFor();
    await button(page, "Remove edit 1").click();
    await button(page, "+ Cut").click();
    await panelOf(page).getByRole("combobox", { name: "Keep" }).selectOption("outside");
    await save(page, "without-box");
    await until(() => greyAt(page, [0.5, 0.5]), (grey) => grey < 2, "the box still shows");
    await page.route(/\/v1\/scenes\/without-box$/, async (route) => {
      const answer = await (await route.fetch()).json();
      const edits = answer.edits.map((edit) => JSON.stringify({ ...JSON.parse(edit), left_out: ["modes of motion"] }));
      await route.fulfill({ json: { ...answer, edits } });
    });
    await page.reload();
    const parents = page.getByTestId("parents");
    await parents.getByText("· Cut, without modes of motion").waitFor();
    assert.match(await parents.getByRole("link", { name: "demo" }).getAttribute("href"), /#\/scan\/demo\?.*pose=/);
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("say beside the value concerned why the service refuses them", async () => {
    const page = await openEdit();
    await button(page, "+ Thin").click();
    await button(page, "+ Relabel").click();
    await button(page, "Paint").click();
    await button(page, "Another shape").click();
    await page.getByLabel("Centre X, mm").fill("5000");
    await page.keyboard.press("Tab");
    await button(page, "1 Thin").click();
    await button(page, "Save as a new scene").click();
    await panelOf(page).locator("p.mistake").getByText("shapes must hold Gaussians of the scene").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    assert.equal(await button(page, "2 Relabel").getAttribute("aria-pressed"), "true");
    await picture(page, "edit-refused");
    await button(page, "Remove edit 2").click();
    await panelOf(page).getByLabel("New scene").fill("demo");
    await button(page, "Save as a new scene").click();
    await panelOf(page).locator("p.mistake").getByText("there is already a scene 'demo'").waitFor();
    assert.equal(await panelOf(page).getByLabel("New scene").getAttribute("aria-invalid"), "true");
  });

  it("paint a label across the image: each stroke is one step, and all of them are one edit", async () => {
    const page = await openEdit();
    await button(page, "+ Relabel").click();
    await panelOf(page).getByRole("textbox", { name: "Label" }).fill("lesion");
    await panelOf(page).getByRole("spinbutton", { name: "Brush radius" }).fill("3");
    await page.keyboard.press("Tab");
    const painted = async () => Number.parseInt(await page.getByTestId("painted").textContent());
    assert.equal(await painted(), 0);
    const ends = { first: [[0.3, 0.4], [0.6, 0.5]], second: [[0.4, 0.7], [0.6, 0.7]] };
    const beginStroke = async ([from, to]) => {
      await page.mouse.move(...(await screenAt(page, from)));
      await page.mouse.down();
      await page.mouse.move(...(await screenAt(page, to)), { steps: 6 });
    };
    await beginStroke(ends.first);
    const outline = await page.getByTestId("outline").boundingBox();
    const [[left, top], [right, bottom]] = await Promise.all(ends.first.map((end) => screenAt(page, end)));
    assert.ok(outline.x < left && outline.y < top && outline.x + outline.width > right && outline.y + outline.height > bottom, "it does not show");
    await picture(page, "edit-painting");
    await new Promise((resolve) => setTimeout(resolve, 700)); // longer than what changes of one step may be apart
    await page.mouse.move(...(await screenAt(page, [0.62, 0.5])), { steps: 3 });
    await page.mouse.up();
    const one = await painted();
    await beginStroke(ends.second);
    await page.mouse.up();
    const both = await painted();
    assert.ok(one > 5 && both > one + 2, `${one}, ${both}`);
    await button(page, "Undo").click();
    assert.equal(await painted(), one);
    await button(page, "Undo").click();
    assert.equal(await painted(), 0);
    await button(page, "Redo").click();
    await button(page, "Redo").click();
    assert.equal(await painted(), both);
    assert.equal(await page.getByTestId("outline").count(), 1);
    await picture(page, "edit-painted");
    assert.deepEqual(await seriousFindings(page), []);

    await save(page, "painted");
    const { label_names, edits } = await scene("painted");
    assert.ok(Object.values(label_names).includes("lesion"), JSON.stringify(label_names));
    const { shapes } = JSON.parse(edits[0]);
    assert.equal(shapes.length, both);
    const apart = shapes.slice(1, one).map(({ centre_mm }, i) => Math.hypot(...centre_mm.map((value, axis) => value - shapes[i].centre_mm[axis])));
    assert.ok(shapes.every(({ radius_mm }) => radius_mm === 3) && apart.every((way) => Math.abs(way - 1.5) < 0.05), String(apart));
    assert.deepEqual(page.faults, []);
  });

  it("are moved by keys, and by a handle in space", async () => {
    const page = await openEdit();
    await button(page, "+ Insert").click();
    const before = await centreOf(page);
    await page.getByRole("button", { name: /^Shape that is worked on/ }).focus();
    await page.keyboard.press("ArrowRight");
    await page.keyboard.press("Shift+ArrowDown");
    const moved = await centreOf(page);
    const way = moved.map((value, axis) => value - before[axis]);
    assert.ok(Math.abs(Math.hypot(...way) - Math.hypot(0.5, 5)) < 0.2 && way[0] > 0.1 && way[2] > 4.5, String(way));
    assert.ok(await dragProbe(page, page.getByTestId("space"), moved, centreOf), "nothing to drag it by");
    assert.deepEqual(page.faults, []);
  });

  it("have room for fingers on a phone, and are placed with them", async () => {
    const page = await openEdit({ width: 390, height: 844, touch: true });
    await button(page, "+ Insert").tap();
    const before = await centreOf(page);
    await page.locator(`${IMAGE} canvas`).first().scrollIntoViewIfNeeded();
    await page.touchscreen.tap(...(await screenAt(page, PLACE)));
    await until(() => centreOf(page), (now) => now[0] !== before[0], "the tap moved nothing");
    await picture(page, "edit-phone-image");
    await panelOf(page).scrollIntoViewIfNeeded();
    await picture(page, "edit-phone");
    assert.deepEqual(await small(page, 44), []);
    assert.deepEqual(await cut(page), []);
    assert.deepEqual(await seriousFindings(page), []);
    assert.deepEqual(page.faults, []);
  });
});
