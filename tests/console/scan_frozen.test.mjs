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

describe("enlarging", () => {
  const box = (page) => page.locator(`${IMAGE} canvas`).first().boundingBox();
  const told = (page) => page.getByRole("button", { name: /%, All of the picture/ }).textContent();

  it("is for what stands; callipers are right in mm at every zoom, and a loupe shows what the finger covers", async () => {
    const { page } = await openFrozen();
    await page.keyboard.press("d");
    await drag(page, [0.25, 0.5], [0.75, 0.5]);
    const [half] = await results(page);
    const whole = await box(page);
    const about = await placeOf(page, 0.5, 0.5);
    await page.mouse.move(...about);
    for (let step = 0; step < 5; step++) await page.mouse.wheel(0, -100);
    await until(() => told(page), (text) => text === "305 %", "the wheel does not zoom");
    const large = await box(page);
    assert.ok(Math.abs(large.width / whole.width - 1.25 ** 5) < 0.01, `${large.width} of ${whole.width}`);
    const now = await placeOf(page, 0.5, 0.5);
    assert.ok(Math.hypot(now[0] - about[0], now[1] - about[1]) < 1.5, `the place under the pointer moved to ${now}`);
    assert.deepEqual(await results(page), [half], "the distance is another one");
    await drag(page, [0.45, 0.5], [0.55, 0.5]);
    const [, tenth] = await results(page);
    assert.ok(Math.abs(parseFloat(tenth) - PROBE_WIDTH_MM / 10) < 0.1, tenth);
    await page.keyboard.press("Escape"); // the tool
    assert.equal(await page.getByTestId("loupe").count(), 0);
    const handle = page.getByLabel(/^B, distance, point 2/);
    const { x, y, width, height } = await handle.boundingBox();
    await page.mouse.move(x + width / 2, y + height / 2);
    await page.mouse.down();
    await page.mouse.move(x + width / 2 + 12, y + height / 2);
    await page.getByTestId("loupe").waitFor();
    const loupe = await page.getByTestId("loupe").boundingBox();
    assert.ok(loupe.y + loupe.height < y, "the loupe lies under the finger");
    const light = await page.getByTestId("loupe").evaluate((canvas) => {
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      return data.reduce((sum, value, index) => sum + (index % 4 === 0 ? value : 0), 0) / (data.length / 4);
    });
    assert.ok(light > 5, "the loupe is empty");
    await picture(page, "scan-loupe");
    await page.mouse.up();
    assert.equal(await page.getByTestId("loupe").count(), 0);
    assert.deepEqual(page.faults, []);
  });

  it("goes by dragging, keys and buttons, and ends with the freeze", async () => {
    const { page } = await openFrozen();
    const whole = await box(page);
    await page.locator(`${IMAGE} .steer`).focus();
    await page.keyboard.press("+");
    await page.getByRole("button", { name: "Zoom in" }).click();
    await until(() => told(page), (text) => text === "156 %", "+ and the button do not zoom");
    const before = await box(page);
    await drag(page, [0.5, 0.5], [0.52, 0.53]);
    const after = await box(page);
    assert.ok(Math.abs(after.x - before.x - 0.02 * before.width) < 2, "dragging does not move it");
    assert.equal(await page.getByTestId("frozen-notice").count(), 0, "what moves the picture is said to steer");
    await page.locator(`${IMAGE} .steer`).focus();
    await page.keyboard.press("ArrowLeft");
    assert.ok((await box(page)).x > after.x + 10, "the arrow keys do not move it");
    await page.keyboard.press("0");
    assert.deepEqual(await box(page), whole);
    await page.keyboard.press("+");
    await page.keyboard.press("f");
    assert.deepEqual([await told(page), await box(page)], ["100 %", whole]);
  });

  it("is done by a pinch", async () => {
    const { page } = await openFrozen();
    const whole = await box(page);
    const [x, y] = await placeOf(page, 0.5, 0.5);
    const fingers = await page.context().newCDPSession(page);
    const touch = (type, apart) =>
      fingers.send("Input.dispatchTouchEvent", { type, touchPoints: apart ? [{ x: x - apart, y, id: 1 }, { x: x + apart, y, id: 2 }] : [] });
    await touch("touchStart", 40);
    for (const apart of [50, 60, 70, 80]) await touch("touchMove", apart);
    await touch("touchEnd", 0);
    const { width } = await until(() => box(page), (now) => now.width > 1.5 * whole.width, "a pinch does not zoom");
    assert.ok(Math.abs(width / whole.width - 2) < 0.1, `${width / whole.width}`);
  });

  it("leaves letters outside what they mark", async () => {
    const { page } = await openFrozen();
    await page.keyboard.press("e");
    await drag(page, [0.35, 0.5], [0.6, 0.5]);
    await page.mouse.click(...(await placeOf(page, 0.48, 0.6)));
    await page.keyboard.press("d");
    await drag(page, [0.6, 0.3], [0.8, 0.2]);
    const over = await page.evaluate(() => {
      const shapes = [...document.querySelectorAll("svg ellipse, svg polyline")];
      return [...document.querySelectorAll('[data-testid="mark-letter"]')].flatMap((letter) => {
        const { left, top, width, height } = letter.getBoundingClientRect();
        const places = Array.from({ length: 81 }, (_, i) => [left + (width * (i % 9)) / 8, top + (height * Math.floor(i / 9)) / 8]);
        return places.filter(([x, y]) =>
          shapes.some((shape) => {
            const point = new DOMPoint(x, y).matrixTransform(shape.getScreenCTM().inverse());
            return (shape.tagName === "ellipse" && shape.isPointInFill(point)) || shape.isPointInStroke(point);
          }),
        );
      });
    });
    assert.deepEqual(over, []);
    assert.deepEqual(await page.getByTestId("mark-letter").allTextContents(), ["A", "B"]);
    await picture(page, "scan-letters");
  });
});

describe("storing", () => {
  it("writes a frame and the loop as DICOM that pydicom and dicom3tools read, with spacing, times, date and measurements", async () => {
    const { page } = await openFrozen();
    const grey = await mean(page);
    const read = async (label) => {
      await page.getByRole("button", { name: "More ways to store" }).click();
      const [download] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: label }).click()]);
      const program = `
import json, pydicom, shutil, subprocess, sys
image = pydicom.dcmread(sys.argv[1])
region = image.SequenceOfUltrasoundRegions[0]
checked = subprocess.run(["dciodvfy", sys.argv[1]], capture_output=True, text=True).stderr if shutil.which("dciodvfy") else ""
print(json.dumps({
  "storage": image.SOPClassUID.name, "frames": image.get("NumberOfFrames"), "size": [image.Rows, image.Columns],
  "width_mm": region.PhysicalDeltaX * 10 * image.Columns, "grey": float(image.pixel_array.mean()), "date": image.ContentDate,
  "times_ms": [float(one) for one in image.get("FrameTimeVector", [])], "said": image.get("ImageComments"), "errors": checked.count("Error"),
}))
`;
      return [download.suggestedFilename(), JSON.parse(execFileSync(PYTHON, ["-c", program, await download.path()]))];
    };
    const [name, one] = await read("Frame, DICOM");
    assert.deepEqual([name, one.storage, one.frames, one.size], ["demo.dcm", "Ultrasound Image Storage", null, [256, 256]]);
    assert.ok(Math.abs(one.width_mm - PROBE_WIDTH_MM) < 0.5, `${one.width_mm} mm`);
    assert.ok(Math.abs(one.grey - grey) < 0.1, "it is another frame");
    assert.ok(Math.abs(Date.now() - Date.parse(`${one.date.slice(0, 4)}-${one.date.slice(4, 6)}-${one.date.slice(6)}`)) < 2 * 86_400_000);
    await page.keyboard.press("d");
    await drag(page, [0.25, 0.5], [0.75, 0.5]);
    const [length] = await results(page);
    const [, measured] = await read("Frame, DICOM");
    assert.deepEqual([measured.said, measured.size[1]], [`A  ${length}`, 768]);
    assert.ok(measured.size[0] > 768, "the result does not stand below the picture");
    const [loop, all] = await read("Cine loop, DICOM");
    const count = Number((await page.getByTestId("cine-place").textContent()).split("/")[1]);
    assert.deepEqual([loop, all.frames, all.times_ms.length, all.said], ["demo-cine.dcm", count, count, `A  ${length}`]);
    assert.equal(all.times_ms[0], 0);
    assert.ok(all.times_ms.slice(1).every((way) => way > 0) && new Set(all.times_ms).size > 2, `no true times: ${all.times_ms}`);
    assert.deepEqual([one.errors, measured.errors, all.errors], [0, 0, 0]);
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
