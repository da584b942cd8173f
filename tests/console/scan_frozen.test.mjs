/** Scan while frozen: one truth about the frame shown, measuring, writing, storing. */

import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { readFileSync } from "node:fs";
import { describe, it } from "node:test";

import { canvasState, picture, PYTHON, seriousFindings, until } from "./harness.mjs";
import { changed, enterPose, IMAGE, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const PROBE_WIDTH_MM = 60; // of the demo scene

const at = tested();
const results = (page) => page.getByTestId("result-value").allTextContents();
const mean = async (page) => (await canvasState(page, IMAGE)).mean;
const frozen = (page) => page.getByRole("button", { name: "Freeze" }).getAttribute("aria-pressed");

/** Scan with a loop of a few frames, frozen at the last. */
async function openFrozen(options) {
  const { page, first } = await openScan(at, options);
  let last = first;
  for (const y of [-10, -5, 0, 5]) {
    await page.getByLabel("Position Y", { exact: true }).fill(String(y));
    last = await changed(page, last.print);
  }
  await page.waitForTimeout(300);
  await page.keyboard.press("f");
  await until(() => frozen(page), (pressed) => pressed === "true", "F does not freeze");
  return { page, first };
}

/** A place of the picture on the screen, in shares of it. */
async function placeOf(page, x, y) {
  const box = await page.locator(`${IMAGE} canvas`).boundingBox();
  return [box.x + box.width * x, box.y + box.height * y];
}

async function drag(page, from, to) {
  await page.mouse.move(...(await placeOf(page, ...from)));
  await page.mouse.down();
  await page.mouse.move(...(await placeOf(page, ...to)), { steps: 4 });
  await page.mouse.up();
}

describe("a frozen image", () => {
  it("is told by the pose, the JSON that is copied and the address alike, frame by frame", async () => {
    const { page, first } = await openFrozen();
    await page.getByLabel("Frame of the cine loop").fill("0");
    await until(() => canvasState(page, IMAGE), ({ print }) => print === first.print, "the first frame is not kept");
    await until(() => poseOf(page), ({ position_mm }) => position_mm.y < -15, "the pose is not that of the frame");
    await page.getByLabel("Copy the pose as JSON").click();
    const copied = JSON.parse(await page.evaluate(() => navigator.clipboard.readText()));
    assert.deepEqual(copied, await poseOf(page));
    await page.getByText("view 106 of 211").waitFor();
    await page.keyboard.press("f");
    await until(() => frozen(page), (pressed) => pressed === "false", "F does not unfreeze");
    await page.waitForTimeout(500);
    assert.deepEqual(await poseOf(page), copied, "the probe jumped");
    assert.ok(Math.abs((await mean(page)) - first.mean) < 0.05, "the image jumped");
  });

  it("is not left by keys, sliders, play, dragging or a gamepad, and that is said", async () => {
    const { page } = await openFrozen();
    const [pose, { print }] = [await poseOf(page), await canvasState(page, IMAGE)];
    await page.locator(`${IMAGE} .steer`).focus();
    await page.keyboard.press("ArrowDown");
    await page.getByTestId("frozen-notice").getByText("Unfreeze first").waitFor();
    await page.keyboard.press("h");
    await page.keyboard.press("n");
    await drag(page, [0.3, 0.5], [0.6, 0.6]);
    await page.evaluate(() => {
      const button = { pressed: false, value: 0 };
      const pad = { id: "Pad", connected: true, axes: [0, 1, 0, 0], buttons: Array(12).fill(button) };
      navigator.getGamepads = () => [pad];
      dispatchEvent(new Event("gamepadconnected"));
    });
    await page.waitForTimeout(400);
    assert.equal(await page.getByRole("button", { name: "Play the sweep" }).isDisabled(), true);
    assert.equal(await page.getByLabel("Position Y", { exact: true }).isDisabled(), true);
    assert.deepEqual([await poseOf(page), (await canvasState(page, IMAGE)).print], [pose, print]);
    assert.deepEqual(page.faults, []);
  });

  it("plays its loop with the pose", async () => {
    const { page } = await openFrozen();
    await page.getByLabel("Frame of the cine loop").fill("0");
    const { position_mm } = await until(() => poseOf(page), (pose) => pose.position_mm.y < -15, "the pose is not that of the frame");
    await page.keyboard.press(" ");
    await until(() => poseOf(page), (pose) => pose.position_mm.y > position_mm.y + 10, "the pose does not follow the loop");
    await page.getByRole("button", { name: "Pause the cine loop" }).click();
    await page.keyboard.press(".");
  });

  it("stays while another view is looked at, with what was measured", async () => {
    const { page } = await openFrozen();
    await page.keyboard.press("d");
    await drag(page, [0.25, 0.5], [0.75, 0.5]);
    await page.getByLabel("Frame of the cine loop").fill("1");
    const { print } = await canvasState(page, IMAGE);
    const pose = await poseOf(page);
    await page.getByRole("link", { name: "Maps", exact: true }).click();
    await until(() => canvasState(page, '[data-testid="map-echo"]'), ({ mean }) => mean > 1, "no map came");
    await page.getByRole("link", { name: "Scan", exact: true }).click();
    await until(() => canvasState(page, IMAGE), (state) => state.print === print, "the frame is gone");
    assert.equal(await frozen(page), "true");
    assert.equal((await results(page)).length, 1);
    assert.deepEqual(await poseOf(page), pose);
  });
});

describe("measuring", () => {
  it("freezes, belongs to its frame, goes at unfreezing and comes back by undo", async () => {
    const { page } = await openScan(at);
    await page.getByRole("button", { name: "Measure" }).click();
    assert.equal(await frozen(page), "true");
    await drag(page, [0.25, 0.5], [0.75, 0.5]);
    const [length] = await results(page);
    assert.ok(Math.abs(parseFloat(length) - PROBE_WIDTH_MM / 2) < 0.4, length);
    assert.equal(await page.getByTestId("frozen-notice").count(), 0, "what measures is said to steer");
    await page.keyboard.press("f");
    assert.deepEqual(await results(page), []);
    assert.equal(await page.getByTestId("mark-letter").count(), 0);
    await page.keyboard.press("Control+z");
    assert.deepEqual([await results(page), await frozen(page)], [[length], "true"]);
    await page.keyboard.press("Control+z");
    assert.deepEqual(await results(page), []);
    await page.keyboard.press("Control+Shift+z");
    assert.deepEqual(await results(page), [length]);
  });

  it("of an ellipse and an angle tells axes, circumference, area and degrees", async () => {
    const { page } = await openFrozen();
    await page.keyboard.press("e");
    await drag(page, [0.3, 0.5], [0.7, 0.5]); // 24 mm
    const [x, y] = await placeOf(page, 0.5, 0.7);
    await page.mouse.click(x, y);
    const [ellipse] = await results(page);
    const [first, second] = ellipse.match(/[\d.]+/g).map(Number);
    assert.ok(Math.abs(first - 0.4 * PROBE_WIDTH_MM) < 0.5 && second > 10, ellipse);
    assert.match(ellipse, /^[\d.]+ × [\d.]+ mm, circumference [\d.]+ mm, area [\d.]+ cm²$/);
    await page.keyboard.press("a");
    await drag(page, [0.2, 0.3], [0.2, 0.6]);
    await page.mouse.click(...(await placeOf(page, 0.5, 0.6)));
    const [, angle] = await results(page);
    assert.ok(Math.abs(parseFloat(angle) - 90) < 2, angle);
    await page.keyboard.press("d");
    await drag(page, [0.1, 0.1], [0.9, 0.9]);
    await drag(page, [0.9, 0.1], [0.1, 0.9]);
    await drag(page, [0.2, 0.1], [0.9, 0.8]);
    const boxes = await page.getByTestId("mark-letter").evaluateAll((all) => all.map((one) => one.getBBox()).map(({ x, y, width, height }) => [x, y, width, height]));
    assert.equal(boxes.length, 5);
    for (const [i, [x1, y1, w1, h1]] of boxes.entries())
      for (const [x2, y2, w2, h2] of boxes.slice(i + 1))
        assert.ok(x1 >= x2 + w2 || x2 >= x1 + w1 || y1 >= y2 + h2 || y2 >= y1 + h1, "letters print over each other");
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "scan-measured");
    await page.getByRole("button", { name: "Remove A", exact: true }).click();
    assert.equal((await results(page)).length, 4);
  });

  it("by keyboard alone puts, moves and removes, and two clicks set a distance", async () => {
    const { page } = await openScan(at);
    await page.getByRole("button", { name: "Measure" }).focus();
    await page.keyboard.press("Enter");
    await until(() => results(page), (all) => all.join() === "10.0 mm", "no distance of a centimetre");
    const focus = () => page.evaluate(() => document.activeElement?.getAttribute("aria-label") ?? "");
    await until(focus, (label) => label.startsWith("A, distance, point 2"), "its end has no focus");
    await page.keyboard.press("Shift+ArrowRight");
    await until(() => results(page), ([one]) => parseFloat(one) > 10.5, "its end does not move");
    await page.keyboard.press("Delete");
    await until(() => results(page), (all) => all.length === 0, "it is not removed");
    await page.mouse.click(...(await placeOf(page, 0.25, 0.5)));
    await page.mouse.click(...(await placeOf(page, 0.75, 0.5)));
    await until(() => results(page), (all) => all.length === 1 && Math.abs(parseFloat(all[0]) - 30) < 0.4, "two clicks are no distance");
    await page.mouse.click(...(await placeOf(page, 0.3, 0.7)));
    await page.keyboard.press("Escape");
    await until(() => results(page), (all) => all.length === 1, "a measurement that was not ended stays");
  });
});

describe("a text", () => {
  it("is put on the image, moved and changed, and its letters are no commands", async () => {
    const { page } = await openScan(at);
    await page.locator(`${IMAGE} .steer`).focus();
    await page.keyboard.press("t");
    await page.keyboard.press("Enter");
    const field = page.getByLabel("Text on the image, Enter sets it");
    await field.pressSequentially("left half, f");
    assert.equal(await frozen(page), "true", "F in a text unfreezes");
    await field.press("Enter");
    const text = page.getByTestId("annotation");
    assert.equal(await text.textContent(), "left half, f");
    const x = Number(await text.getAttribute("x"));
    await page.keyboard.press("Shift+ArrowRight");
    await until(async () => Number(await text.getAttribute("x")), (now) => Math.abs(now - x - 10) < 0.5, "it does not move");
    await page.keyboard.press("Escape");
    await picture(page, "scan-annotated");
    assert.deepEqual(page.faults, []);
  });
});

describe("storing", () => {
  it("writes a frame and the loop as DICOM that pydicom reads, with the right spacing", async () => {
    const { page } = await openFrozen();
    const read = async (label) => {
      await page.getByRole("button", { name: "More ways to store" }).click();
      const [download] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: label }).click()]);
      const program = `
import pydicom, sys
image = pydicom.dcmread(sys.argv[1])
region = image.SequenceOfUltrasoundRegions[0]
print(int(image.get("NumberOfFrames", 1)), image.Rows, image.Columns, region.PhysicalDeltaX * 10 * image.Columns, image.pixel_array.mean())
`;
      const told = execFileSync(PYTHON, ["-c", program, await download.path()]).toString().trim().split(" ").map(Number);
      return [download.suggestedFilename(), ...told];
    };
    const [name, frames, rows, columns, width_mm, grey] = await read("Frame, DICOM");
    assert.deepEqual([name, frames, rows, columns], ["demo.dcm", 1, 256, 256]);
    assert.ok(Math.abs(width_mm - PROBE_WIDTH_MM) < 0.5, `${width_mm} mm`);
    assert.ok(Math.abs(grey - (await mean(page))) < 0.1, "it is another frame");
    const [loop, count] = await read(/Cine loop, DICOM/);
    const all = Number((await page.getByTestId("cine-place").textContent()).split("/")[1]);
    assert.deepEqual([loop, count], ["demo-cine.dcm", all]);
  });

  it("records the loop as a video", async () => {
    const { page } = await openFrozen();
    await page.getByRole("button", { name: "More ways to store" }).click();
    await picture(page, "scan-store");
    const [download] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: /Cine loop, video/ }).click()]);
    const bytes = readFileSync(await download.path());
    assert.match(download.suggestedFilename(), /^demo-cine\.(mp4|webm)$/);
    const isWebm = bytes.readUInt32BE(0) === 0x1a45dfa3;
    assert.ok(isWebm || bytes.subarray(4, 8).toString() === "ftyp", "it is no video");
    assert.ok(bytes.length > 20_000, `${bytes.length} bytes`);
    assert.deepEqual(page.faults, []);
  });

  it("says what it measured, how sure it is and what it is, on the picture of the frame shown", async () => {
    const init = () => {
      globalThis.words = [];
      const { fillText } = CanvasRenderingContext2D.prototype;
      CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
        globalThis.words.push(text);
        return fillText.call(this, text, x, y);
      };
    };
    const { page } = await openFrozen({ init });
    await page.getByLabel("Frame of the cine loop").fill("0");
    await page.keyboard.press("d");
    await drag(page, [0.25, 0.5], [0.75, 0.5]);
    const pose = await poseOf(page);
    await Promise.all([page.waitForEvent("download"), page.keyboard.press("s")]);
    const words = (await page.evaluate(() => globalThis.words)).join("\n");
    for (const told of [/^A {2}30\.\d mm/m, /Well supported, expected similarity \d+ %/, /Simulated, not for diagnosis/]) assert.match(words, told);
    assert.ok(words.replaceAll("\n", "").includes(JSON.stringify(pose)), "the pose is not that of the frame");
  });
});

describe("an address", () => {
  it("of a frozen frame opens at its pose", async () => {
    const { page } = await openFrozen();
    const pose = await poseOf(page);
    const told = (url) => Number(/pose=([^&]*)/.exec(url)?.[1].split("_")[1]);
    await until(() => page.url(), (url) => Math.abs(told(url) - pose.position_mm.y) < 1e-3, "the address tells another pose");
    await page.reload();
    await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    assert.deepEqual(await poseOf(page), pose);
    await enterPose(page, JSON.stringify(pose));
  });
});
