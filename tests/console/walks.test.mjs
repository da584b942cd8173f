/** Walks: each kind of user from the first page to what they came for, with a picture of every station. */

import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { mkdirSync } from "node:fs";
import path from "node:path";
import { after, before, describe, it } from "node:test";

import {
  BACKGROUND_TIMEOUT_MS,
  canvasState,
  goTo,
  laidOut,
  launch,
  openPage,
  PYTHON,
  ROOT,
  SCREENSHOTS,
  Service,
  SOURCES,
  until,
} from "./harness.mjs";
import { changed, enterPose, IMAGE, poseOf } from "./scan_page.mjs";
import { makeSweep } from "./sweep.mjs";

const MINUTES_MS = 900_000; // a training and a thousand frames on a busy machine
const RENDERED = 1_000;
const ENVIRONMENT = { ...process.env, PYTHONPATH: `${SOURCES}:${path.join(ROOT, "client")}` };

const at = {};
before(async () => {
  at.files = makeSweep();
  at.service = await Service.start({ ULTRAGRAY_EMBEDDED_WORKER: "true", ULTRAGRAY_TRAINING_THREADS: "1" });
  at.browser = await launch();
});
after(async () => {
  await at.browser?.close();
  await at.service?.stop();
  at.files?.remove();
});

/** Takes the pictures of a walk: walk-WHO-1-WHERE.png and so on. */
function walker(page, who) {
  let number = 0;
  mkdirSync(SCREENSHOTS, { recursive: true });
  return async (where) => {
    await laidOut(page);
    number += 1;
    await page.screenshot({ path: path.join(SCREENSHOTS, `walk-${who}-${number}-${where}.png`) });
  };
}

async function download(page, press) {
  const [file] = await Promise.all([page.waitForEvent("download", { timeout: MINUTES_MS }), press()]);
  return { name: file.suggestedFilename(), path: await file.path() };
}

/** The dark disc with the brightest surroundings: a vessel. Its middle and half its width, in shares of the picture. */
function vesselOf(page) {
  return page.locator(`${IMAGE} canvas`).evaluate((canvas) => {
    const { width, height } = canvas;
    const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
    const grey = (x, y) => data[4 * (Math.round(y) * width + Math.round(x))];
    const around = Array.from({ length: 24 }, (_, i) => [Math.cos((i * Math.PI) / 12), Math.sin((i * Math.PI) / 12)]);
    const ring = (x, y, radius) => around.map(([dx, dy]) => grey(x + radius * dx, y + radius * dy));
    const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
    const [within, beyond] = [0.027 * width, 0.06 * width]; // of 60 mm; the vessel's radius lies between
    let best = { contrast: -Infinity };
    for (let y = 0.2 * height; y < 0.7 * height; y += 1)
      for (let x = 0.1 * width; x < 0.9 * width; x += 1) {
        const inside = [grey(x, y), ...ring(x, y, within / 2), ...ring(x, y, within)];
        const outside = ring(x, y, beyond).sort((a, b) => a - b);
        const contrast = outside[1] - Math.max(...inside); // a shadow is dark around as well
        if (contrast > best.contrast) best = { contrast, x, y };
      }
    const wall = mean(ring(best.x, best.y, beyond)) / 2;
    const reach = (side) => {
      let dx = 0;
      while (grey(best.x + side * dx, best.y) < wall) dx += 1;
      return side * dx;
    };
    const [left, right] = [reach(-1), reach(1)];
    return { x: (best.x + (left + right) / 2 + 0.5) / width, y: (best.y + 0.5) / height, half: (right - left) / 2 / width };
  });
}

function python(program, ...words) {
  return execFileSync(PYTHON, ["-c", program, ...words], { env: ENVIRONMENT, encoding: "utf8", timeout: MINUTES_MS }).trim();
}

describe("a sonographer", () => {
  it("finds a vessel, freezes, measures and stores it", async () => {
    const page = await openPage(at, "", { width: 1440, height: 900 });
    const seen = walker(page, "sonographer");
    const first = await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    await seen("arrives");
    const start = await poseOf(page);

    await page.getByLabel("Gain", { exact: true }).fill("4");
    const brighter = await changed(page, first.print);
    await page.getByRole("button", { name: "Play the sweep" }).click();
    await changed(page, brighter.print);
    await page.waitForTimeout(1500);
    await page.getByRole("button", { name: "Pause the sweep" }).click();
    const paused = await canvasState(page, IMAGE);
    await enterPose(page, JSON.stringify(start)); // where the sweep pauses, the vessel may be cut at a slant
    await changed(page, paused.print);
    await page.locator(`${IMAGE} .steer`).focus();
    const before = await canvasState(page, IMAGE);
    for (let tap = 0; tap < 6; tap++) await page.keyboard.press("ArrowRight");
    await changed(page, before.print);
    await seen("finds");

    await page.keyboard.press("f");
    await page.keyboard.press(",");
    await seen("freezes");

    const box = await page.locator(`${IMAGE} canvas`).boundingBox();
    const point = (x, y) => [box.x + box.width * x, box.y + box.height * y];
    const drag = async (from, to) => {
      await page.mouse.move(...point(...from));
      await page.mouse.down();
      await page.mouse.move(...point(...to), { steps: 4 });
      await page.mouse.up();
    };
    const vessel = await vesselOf(page);
    await page.keyboard.press("d");
    await drag([vessel.x - vessel.half, vessel.y], [vessel.x + vessel.half, vessel.y]);
    await page.keyboard.press("e");
    await drag([vessel.x, vessel.y - vessel.half], [vessel.x, vessel.y + vessel.half]);
    await page.mouse.click(...point(vessel.x + vessel.half, vessel.y));
    const measured = page.getByTestId("result-value");
    await until(() => measured.count(), (count) => count === 2, "there are not two results");
    const [diameter_mm] = (await measured.allTextContents()).map(parseFloat);
    assert.ok(diameter_mm > 3 && diameter_mm < 6, `${diameter_mm} mm; the vessel of the demo is 4.5 mm wide`);
    assert.equal(await page.getByTestId("frozen-notice").count(), 0);
    await seen("measures");

    const told = await poseOf(page);
    const picture = await download(page, () => page.keyboard.press("s"));
    assert.match(picture.name, /^demo.*\.png$/);
    await page.getByRole("button", { name: "More ways to store" }).click();
    await seen("stores");
    const loop = await download(page, () => page.getByRole("button", { name: /Cine loop, DICOM/ }).click());
    const program = `
import json, pydicom, shutil, subprocess, sys
image = pydicom.dcmread(sys.argv[1])
checked = subprocess.run(["dciodvfy", sys.argv[1]], capture_output=True, text=True).stderr if shutil.which("dciodvfy") else ""
print(json.dumps([image.get("NumberOfFrames", 1), image.get("ImageComments"), checked.count("Error")]))
`;
    const [count, comments, errors] = JSON.parse(python(program, loop.path));
    assert.ok(count > 5, "the loop has hardly a frame");
    assert.match(comments, new RegExp(`A  ${diameter_mm.toFixed(1)} mm`));
    assert.equal(errors, 0);
    assert.deepEqual(await poseOf(page), told);
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });
});

describe("a robotics engineer", () => {
  it("connects, follows the robot, records its path and takes it home as poses and as frames", async () => {
    const page = await openPage(at, "#/scan/demo", { width: 1440, height: 900 });
    const seen = walker(page, "robotics");
    await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    const snippet = page.getByTestId("snippet");
    await page.getByLabel("Language of the example").selectOption("websocket");
    await snippet.scrollIntoViewIfNeeded();
    assert.match(await snippet.inputValue(), new RegExp(at.service.url.replace("http", "ws")));
    await seen("connects");

    const address = `${at.service.url.replace("http", "ws")}/v1/scenes/demo/stream?name=UR5`;
    const robot = spawn(PYTHON, [path.join(ROOT, "tests/console/robot.py"), address, "{}"], {
      env: ENVIRONMENT,
      stdio: ["pipe", "ignore", "inherit"],
    });
    try {
      await page.getByText("Open streams").click();
      await page.getByRole("button", { name: "Follow UR5" }).click();
      await page.getByTestId("following").getByText("Following UR5").waitFor();
      await page.getByLabel("Latency on the image").check();
      await page.getByRole("button", { name: "Record", exact: true }).click();
      robot.stdin.write("run 20\n");
      await page.getByTestId("latency").getByText("rendered in").waitFor();
      const recorded = async () => Number((await page.getByTestId("recording").textContent()).match(/(\d+) poses/)[1]);
      await until(recorded, (count) => count >= 30, "the path of the robot is not recorded");
      await seen("follows");
      await page.getByRole("button", { name: "Stop recording" }).click();
    } finally {
      robot.kill("SIGTERM");
    }
    await page.getByTestId("path-summary").scrollIntoViewIfNeeded();
    await seen("recorded");

    const panel = page.getByRole("region", { name: "Path of the probe" });
    await panel.getByLabel("Save poses").selectOption("csv");
    const poses = await download(page, () => panel.getByRole("button", { name: "Save poses" }).click());
    const count = Number((await panel.getByTestId("path-summary").textContent()).match(/(\d+) poses/)[1]);
    assert.equal(python("import sys; print(sum(1 for _ in open(sys.argv[1])) - 1)", poses.path), String(count));
    await panel.getByRole("button", { name: "Render as a data set" }).click();
    await panel.getByTestId("path-job").click();
    await page.getByTestId("job-state").getByText("succeeded").waitFor({ timeout: MINUTES_MS });
    await seen("rendered");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });
});

describe("a machine learning engineer", () => {
  it("uploads a sweep, trains, compares, and renders a thousand frames", async () => {
    const page = await openPage(at, "", { width: 1440, height: 900 });
    const seen = walker(page, "learning");
    await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    await goTo(page, "Train");
    await page.getByLabel("Add a sweep").setInputFiles(at.files.sweep);
    await page.getByLabel("Name", { exact: true }).fill("sweep");
    await page.getByRole("button", { name: "Upload and check" }).click();
    await page.getByText("28 to train from, 5 held out").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    await page.getByRole("img", { name: "Frame 0 of sweep" }).waitFor();
    await seen("uploads");

    const form = page.getByRole("region", { name: "Training", exact: true });
    await form.getByLabel("Scene", { exact: true }).fill("mine");
    await form.getByLabel("Steps").fill("150");
    await form.getByLabel("Most Gaussians").fill("2000");
    await page.getByRole("button", { name: "Start the training" }).click();
    const state = page.getByTestId("job-state");
    await page.getByText(/^Step [1-9][\d,]* of 150$/).waitFor({ timeout: MINUTES_MS });
    await seen("trains");
    await state.getByText("succeeded").waitFor({ timeout: MINUTES_MS });
    await seen("trained");

    await goTo(page, "Compare");
    await page.getByRole("banner").getByRole("combobox", { name: "Scene" }).selectOption("mine");
    await page.getByTestId("comparison").waitFor({ timeout: MINUTES_MS });
    await page.getByLabel("Compare the truth with").selectOption({ label: "Median compounding" });
    await seen("compares");

    await goTo(page, "Train");
    await page.getByRole("navigation", { name: "Sections" }).getByRole("link", { name: "Render a data set" }).click();
    await page.getByRole("main").getByRole("combobox", { name: "Scene" }).selectOption("mine");
    await page.getByLabel("Count").fill(String(RENDERED));
    await page.getByLabel("Count").press("Tab");
    await page.getByRole("combobox", { name: "Format" }).selectOption("hdf5");
    await page.getByTestId("estimate").getByText("1,000").waitFor();
    await page.getByTestId("estimate").getByText(/^about .* on one process/).waitFor();
    await seen("plans");
    await page.getByRole("button", { name: "Start rendering" }).click();
    await state.getByText("succeeded").waitFor({ timeout: MINUTES_MS });
    await seen("renders");
    const file = await download(page, () => page.getByRole("link", { name: /\.h5$/ }).click());
    const shape = 'import h5py, sys; print(*h5py.File(sys.argv[1])["bmode"].shape)';
    assert.equal(python(shape, file.path), `${RENDERED} 64 64`);
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });
});
