/** Scan: poses that are entered and loaded, measuring and steering by keyboard, confidence, and what is saved. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import path from "node:path";
import { describe, it } from "node:test";

import { canvasState, picture, seriousFindings, until } from "./harness.mjs";
import { changed, enterPose, IMAGE, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const POSES = [0, 4, 8].map((y) => [[1, 0, 0, 2], [0, 1, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]]);

const at = tested();

/** Notes the words that are drawn into pictures, and whether they fit. */
function watchWords() {
  globalThis.words = [];
  const { fillText } = CanvasRenderingContext2D.prototype;
  CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
    const right = x + this.measureText(text).width;
    globalThis.words.push({ text, fits: right <= this.canvas.width && y <= this.canvas.height, left: x < this.canvas.width / 2 });
    return fillText.call(this, text, x, y);
  };
}

/** How far a tap of a key moves the probe, mm: one that is over before the next picture is drawn. */
async function tap_mm(page, key, altKey) {
  const before = await poseOf(page);
  await page.evaluate(({ key, altKey }) => {
    for (const type of ["keydown", "keyup"])
      document.activeElement.dispatchEvent(new KeyboardEvent(type, { key, altKey, bubbles: true }));
  }, { key, altKey });
  const distance_mm = ({ position_mm: at }) => Math.abs(at.x - before.position_mm.x); // another key's last step may come along z
  return distance_mm(await until(() => poseOf(page), (pose) => distance_mm(pose) > 0, `${key} is not heard`));
}

/** A file of poses, as the page is given one. */
function poseFile(document) {
  return { name: "poses.json", mimeType: "application/json", buffer: Buffer.from(JSON.stringify(document)) };
}

describe("poses", () => {
  it("that are no rigid transforms are refused in words", async () => {
    const { page } = await openScan(at);
    const pose = await poseOf(page);
    const refused = [
      ["null", "a pose is an object"],
      ['{"matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[5,6,7,1]]}', "must end in the row 0 0 0 1"],
      ['{"matrix": [[-1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}', "this one mirrors"],
      ['{"matrix": [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]}', "must hold a rotation"],
    ];
    for (const [text, words] of refused) {
      await enterPose(page, text);
      await page.getByRole("alert").getByText(words).waitFor();
    }
    await page.getByLabel("Pose as JSON, Enter applies").press("Escape");
    assert.deepEqual(await poseOf(page), pose);
    await enterPose(page, JSON.stringify({ matrix: POSES[1] }));
    await until(() => poseOf(page), ({ position_mm: { x, y } }) => x === 2 && y === 4, "the matrix was not taken");
  });

  it("of a file are played, and the training sweep comes back", async () => {
    const { page } = await openScan(at);
    await page.getByText("view 106 of 211").waitFor();
    await page.getByLabel("Position X", { exact: true }).fill("9");
    await page.getByText("beside the views").waitFor();
    const file = page.getByLabel("File of poses");
    await file.setInputFiles(poseFile([POSES[0], { matrix: [[1, 2], [3]] }]));
    await page.getByText("poses.json: Pose 2: 3 numbers were found; 12 or 16 were expected.").waitFor();
    const quaternion = { position_mm: { x: 2, y: 8, z: 0 }, quaternion: { w: 1, x: 0, y: 0, z: 0 } };
    await file.setInputFiles(poseFile({ poses: [...POSES.slice(0, 2), quaternion] }));
    await page.getByText("pose 1 of 3").waitFor();
    assert.deepEqual((await poseOf(page)).position_mm, { x: 2, y: 0, z: 0 });
    await page.getByRole("button", { name: "Play the sweep" }).click();
    await until(() => poseOf(page), ({ position_mm: { y } }) => y > 4, "it is not played");
    await page.getByRole("button", { name: "Pause the sweep" }).click();
    await page.getByLabel("Place in poses.json").fill("2");
    await until(() => poseOf(page), ({ position_mm: { y } }) => y === 8, "the last pose is not there");
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "scan-trajectory");
    await page.getByRole("button", { name: "Back to the training sweep" }).click();
    await page.getByText("view 106 of 211").waitFor();
    assert.deepEqual(page.faults, []);
  });

  it("are steered by keys after a button was pressed, finely with Alt", async () => {
    const { page } = await openScan(at);
    await page.getByRole("button", { name: "Snap" }).click();
    const before = await poseOf(page);
    await page.keyboard.press("ArrowRight");
    await until(() => poseOf(page), ({ position_mm }) => position_mm.x > before.position_mm.x, "the key is not heard");
    const moved = await poseOf(page);
    await page.keyboard.press("Alt+PageDown");
    await until(() => poseOf(page), ({ position_mm }) => position_mm.z > moved.position_mm.z, "Alt is not heard");
    const [coarse_mm, fine_mm] = [await tap_mm(page, "ArrowRight", false), await tap_mm(page, "ArrowRight", true)];
    assert.ok(Math.abs(fine_mm - coarse_mm / 5) < 0.01, `${fine_mm} mm with Alt, ${coarse_mm} mm without`);
  });
});

describe("the image", () => {
  it("goes back to its full depth by the slider where that is no whole number", async () => {
    const { page } = await openScan(at);
    await page.route(/\/v1\/scenes\/demo$/, async (route) => {
      const scene = await (await route.fetch()).json();
      await route.fulfill({ json: { ...scene, probe: { ...scene.probe, far_mm: 59.35 } } });
    });
    await page.reload();
    const depth = page.getByLabel("Depth", { exact: true });
    await until(() => depth.getAttribute("max"), (max) => max === "60", "the slider ends above the full depth");
    await depth.fill("30");
    await until(() => canvasState(page, IMAGE), ({ height }) => height === 128, "the depth is not half of it");
    await depth.fill("60");
    await until(() => canvasState(page, IMAGE), ({ height }) => height === 256, "the depth is not full again");
  });

  it("is black where nothing supports it, if that is asked for, and tells how sure its figure is", async () => {
    const { page, first } = await openScan(at);
    const { confidence } = await (await fetch(`${at.service.url}/v1/scenes/demo`)).json();
    await page.getByTestId("similarity-error").getByText(`${Math.round(confidence.error * 100)} percentage points`).waitFor();
    await page.getByLabel("Tilt, about the lateral axis", { exact: true }).fill("60");
    const tilted = await changed(page, first.print);
    await page.getByLabel("Black where nothing supports it").check();
    const black = await changed(page, tilted.print);
    assert.ok(black.mean < tilted.mean, `${black.mean} after ${tilted.mean}`);
    await page.getByLabel("Black where nothing supports it").uncheck();
    await until(() => canvasState(page, IMAGE), ({ print }) => print !== black.print, "it stays black");
    await picture(page, "scan-unsupported");
  });

  it("is saved with all words of what it is, and its side", async () => {
    const { page, first } = await openScan(at, { init: watchWords });
    await page.getByRole("combobox", { name: "Probe" }).selectOption("linear"); // narrower than the words are long
    const narrow = await changed(page, first.print);
    await page.getByText("view 106 of 211").waitFor(); // the probe is where it was
    await page.getByRole("button", { name: "Add a needle" }).click();
    const needle = await changed(page, narrow.print);
    await page.getByLabel("Ghost echoes", { exact: true }).fill("0.5");
    await changed(page, needle.print);
    for (const side of ["left", "right"]) {
      await page.evaluate(() => (globalThis.words = []));
      const [download] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: "Save" }).click()]);
      assert.ok(readFileSync(await download.path()).length > 1000);
      const words = await page.evaluate(() => globalThis.words);
      assert.deepEqual(words.filter(({ fits }) => !fits), []);
      assert.match(words.map(({ text }) => text).join("\n"), /Simulated, not for diagnosis\.[^]*demo[^]*slice 0\.0 mm[^]*Drawn in: Needle[^]*Ghost echoes[^]*"quaternion"/);
      assert.equal(words.find(({ text }) => text === "U").left, side === "left");
      await page.getByLabel("Flip").check();
      await page.locator('[data-testid="orientation-marker"][data-side="right"]').waitFor();
    }
  });
});

describe("a probe by its name", () => {
  it("is chosen as such, and is set nearer and farther by sliders", async () => {
    const { page, first } = await openScan(at);
    const probe = page.getByRole("combobox", { name: "Probe" });
    await probe.selectOption("C5-2");
    await changed(page, first.print);
    const [near, far] = ["Near", "Far"].map((name) => page.getByRole("slider", { name, exact: true }));
    assert.deepEqual([await near.inputValue(), await far.inputValue()], ["50", "200"]);
    assert.equal(await probe.inputValue(), "C5-2");
    await far.fill("120");
    await until(() => probe.inputValue(), (kind) => kind === "convex", "it has still the name of another");
    await until(() => near.getAttribute("max"), (most) => most === "119.5", "near may lie beyond far");
    assert.deepEqual(page.faults, []);
  });
});

describe("a scene that another takes the place of", () => {
  it("is not scanned with the probe that was chosen for it", async () => {
    const file = readFileSync(path.join(at.service.data, "demo.ugr"));
    await putOther(file);
    const { page, first } = await openScan(at, { scene: "other" });
    await page.getByRole("combobox", { name: "Probe" }).selectOption("convex");
    await changed(page, first.print);
    await deleteOther();
    await putOther(renamedDataset(file));
    const connected = page.waitForEvent("websocket");
    await page.getByRole("link", { name: "Train", exact: true }).click();
    await page.getByRole("link", { name: "Scan", exact: true }).click();
    await connected;
    await until(() => page.getByRole("combobox", { name: "Probe" }).inputValue(), (value) => value === "own", "the old probe stays");
    await page.context().close();
    await deleteOther();
  });

  it("is known while Scan stays open, also where the service was full when it was asked", async () => {
    const file = readFileSync(path.join(at.service.data, "demo.ugr"));
    await putOther(file);
    const { page, first } = await openScan(at, { scene: "other" });
    await page.getByRole("combobox", { name: "Probe" }).selectOption("convex");
    await changed(page, first.print);
    await deleteOther();
    await putOther(renamedDataset(file));
    let full = true;
    await page.route(/\/v1\/scenes\/other$/, (route) => (full ? route.fulfill({ status: 503 }) : route.continue()));
    const refused = page.waitForResponse((answer) => answer.status() === 503);
    await page.getByLabel("Position Y", { exact: true }).fill("3");
    await refused;
    full = false;
    await until(() => page.getByRole("combobox", { name: "Probe" }).inputValue(), (value) => value === "own", "the old probe stays");
    await page.getByText("view 106 of 211").waitFor();
    await page.context().close();
    await deleteOther();
  });
});

async function putOther(body) {
  assert.equal((await fetch(`${at.service.url}/v1/scenes/other`, { method: "PUT", body })).status, 201);
}

async function deleteOther() {
  assert.ok((await fetch(`${at.service.url}/v1/scenes/other`, { method: "DELETE" })).ok);
}

/** The scene file as if it were trained from another dataset. */
function renamedDataset(file) {
  const length = Number(file.readBigUInt64LE(0));
  const header = file.subarray(8, 8 + length).toString();
  const other = header.replace("demo lumbar spine", "demo LUMBAR spine"); // of the same length
  assert.notEqual(other, header);
  return Buffer.concat([file.subarray(0, 8), Buffer.from(other), file.subarray(8 + length)]);
}
