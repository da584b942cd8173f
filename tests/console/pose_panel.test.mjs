/** The pose in numbers and as text, and paths of the probe: loaded, recorded, saved, rendered. */

import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import path from "node:path";
import { describe, it } from "node:test";

import { BACKGROUND_TIMEOUT_MS, picture, PYTHON, seriousFindings, until } from "./harness.mjs";
import { enterPose, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const at = tested({ environment: { ULTRAGRAY_EMBEDDED_WORKER: "true" } });
const TURNED = '{"position_mm": {"x": 4, "y": 10, "z": 1}, "quaternion": {"w": 0.9961947, "x": 0, "y": 0, "z": 0.0871557}}';

async function type(page, label, text) {
  const field = page.getByLabel(label, { exact: true });
  await field.fill(text);
  await field.press("Enter");
}

function load(page, name, text) {
  return page.getByLabel("File of poses").setInputFiles({ name, mimeType: "text/plain", buffer: Buffer.from(text) });
}

describe("the pose panel", () => {
  it("says against what it tells, and moves along what it says", async () => {
    const { page } = await openScan(at);
    const panel = page.getByRole("region", { name: "Pose", exact: true });
    await enterPose(page, TURNED);
    await panel.getByText("Position in the scene").waitFor();
    await panel.getByText("Angles against the scene's axes").waitFor();
    await until(() => page.getByLabel("Position X, mm").inputValue(), (value) => value === "4.0", "not the place in the scene");
    await page.getByRole("button", { name: "Mark", exact: true }).click();
    await panel.getByText("Way from the mark").waitFor();
    await panel.getByText("Turn against the mark").waitFor();
    for (const label of ["Position Lateral, mm", "Position Elevation, mm", "Tilt, about the lateral axis, °", "Rotate, about the axial axis, °"])
      assert.equal(await page.getByLabel(label, { exact: true }).inputValue(), "0.0");
    await type(page, "Position Lateral, mm", "10");
    const { position_mm } = await until(() => poseOf(page), ({ position_mm: p }) => p.x !== 4, "it did not move");
    assert.ok(Math.abs(position_mm.x - (4 + 10 * Math.cos(Math.PI / 18))) < 0.02, JSON.stringify(position_mm));
    assert.ok(Math.abs(position_mm.y - (10 + 10 * Math.sin(Math.PI / 18))) < 0.02, JSON.stringify(position_mm));
    await panel.getByLabel("Shown as").selectOption("relativeScene");
    await until(() => page.getByLabel("Position X, mm").inputValue(), (value) => value === "9.8", "not along the scene's axes");
    await panel.getByLabel("from", { exact: true }).selectOption({ label: "Home" });
    await panel.getByText("Way from Home").waitFor();
    await picture(page, "pose-relative");
    assert.deepEqual(await seriousFindings(page), []);
    assert.deepEqual(page.faults, []);
  });

  it("takes what is typed beyond the sliders and says so; what it cannot take it leaves and says why", async () => {
    const { page } = await openScan(at);
    const remark = page.getByTestId("pose-remark");
    await type(page, "Position Y, mm", "400");
    await remark.getByText("Y 400 mm lies outside of the scene").waitFor();
    await until(() => poseOf(page), ({ position_mm }) => position_mm.y === 400, "it was clamped");
    await type(page, "Position Y, mm", "123456");
    await remark.getByText("Y may be at most 10000 mm either way. It was not changed.").waitFor();
    assert.equal((await poseOf(page)).position_mm.y, 400);
    await type(page, "Position Y, mm", "");
    await remark.getByText("Y must be a number. It was not changed.").waitFor();
    await type(page, "Rock, about the elevation axis, °", "120");
    await remark.getByText("Rock 120° is the same orientation as Tilt").waitFor();
    await type(page, "Position Y, mm", "12");
    await remark.waitFor({ state: "detached" });
  });

  it("shows, copies and takes a pose in every form", async () => {
    const { page } = await openScan(at);
    await enterPose(page, TURNED);
    const forms = { matrix: "Matrix", quaternion: "Quaternion", euler: "Euler angles", numpy: "NumPy", ros: "ROS" };
    for (const [form, name] of Object.entries(forms)) {
      await page.getByLabel("Form of the pose").selectOption(form);
      const area = page.getByLabel(`Pose as ${name}, Enter applies`);
      const text = await area.inputValue();
      await page.getByLabel(`Copy the pose as ${name}`).click();
      await until(() => page.evaluate(() => navigator.clipboard.readText()), (copied) => copied === text, `${name} was not copied`);
      await page.getByRole("button", { name: "Home", exact: true }).click();
      await until(() => area.inputValue(), (now) => now !== text, "Home is there already");
      await area.fill(text);
      await page.keyboard.press("Enter");
      await page.getByLabel("Form of the pose").selectOption("json");
      await until(() => poseOf(page), ({ position_mm }) => position_mm.x === 4 && position_mm.y === 10, `${name} was not taken`);
    }
    await page.getByLabel("Form of the pose").selectOption("ros");
    await page.getByLabel("Pose as ROS, Enter applies").fill("position: {x: 1}");
    await page.keyboard.press("Enter");
    await page.getByText("A pose of ROS has a position and an orientation; position.y was not found.").waitFor();
  });
});

describe("the path of the probe", () => {
  it("is loaded from TUM's file in metres, or in the unit that one says", async () => {
    const { page } = await openScan(at);
    await load(page, "path.tum", "0 0.004 0.01 0 0 0 0 1\n1 0.005 0.012 0 0 0 0 1\n");
    await page.getByText("read as metres").waitFor();
    await until(() => poseOf(page), ({ position_mm }) => position_mm.x === 4 && position_mm.y === 10, "not in metres");
    await page.getByLabel("Unit of the file").selectOption("mm");
    await until(() => poseOf(page), ({ position_mm }) => position_mm.x === 0.004, "not in millimetres");
    await page.getByTestId("path-summary").getByText("2 poses").waitFor();
    await load(page, "broken.tum", "0 0 0 0 0 0 0 1\n0 1 2 3\n").catch(() => undefined);
    await page.getByRole("button", { name: "Back to the training sweep" }).click();
    await load(page, "broken.tum", "0 0 0 0 0 0 0 1\n0 1 2 3\n");
    await page.getByText("broken.tum: Line 2: 4 numbers were found; 8 were expected.").waitFor();
    assert.deepEqual(page.faults, []);
  });

  it("is recorded, played, saved, and rendered as a data set", async () => {
    const { page } = await openScan(at);
    await page.getByRole("button", { name: "Record" }).click();
    await page.getByLabel("Position Y", { exact: true }).fill("0");
    await page.waitForTimeout(300);
    await page.getByLabel("Position Y", { exact: true }).fill("8");
    await until(() => page.getByTestId("recording").textContent(), (text) => parseFloat(text) > 1, "it does not run");
    await page.getByRole("button", { name: "Stop recording" }).click();
    await page.getByTestId("path-summary").getByText("recording 1").waitFor();
    const saved = async (format) => {
      await page.getByLabel("Save poses", { exact: true }).selectOption(format);
      const [download] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: "Save poses" }).click()]);
      assert.equal(download.suggestedFilename(), `recording 1.${format}`);
      return readFileSync(await download.path());
    };
    const { poses, times_s } = JSON.parse(await saved("json"));
    assert.ok(poses.length > 10 && poses.length === times_s.length, `${poses.length} poses`);
    assert.deepEqual([poses.at(-1).position_mm.y, times_s.every((time, i) => i === 0 || time > times_s[i - 1])], [8, true]);
    assert.equal((await saved("csv")).toString().split("\n")[0], "time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz");
    assert.ok((await saved("tum")).toString().startsWith("# timestamp"));
    assert.equal((await saved("npy")).subarray(1, 6).toString(), "NUMPY");
    await picture(page, "path-recorded");

    await page.getByRole("button", { name: "Render as a data set" }).click();
    await page.getByTestId("path-job").click();
    await page.getByTestId("job-state").getByText("succeeded").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    await page.getByRole("link", { name: "frames.npz" }).waitFor();
    const rendered = page.getByRole("region", { name: "Rendered frames" });
    await until(() => rendered.getByRole("img").count(), (count) => count === 6, "no examples");
    await until(() => rendered.locator("figure img").evaluateAll((all) => all.every((one) => one.naturalWidth >= 200)), Boolean, "they are empty");
    await rendered.getByText("Frame 0", { exact: true }).waitFor();
    assert.match(await rendered.getByTestId("confidence-range").textContent(), /^Confidence 0\.\d\d to 0\.\d\d, mean 0\.\d\d$/);
    assert.match(await rendered.getByTestId("rendered-settings").textContent(), /Format\s*npz/);
    const [file] = await Promise.all([page.waitForEvent("download"), page.getByRole("link", { name: "frames.npz" }).click()]);
    const folder = mkdtempSync(path.join(tmpdir(), "ultragray-frames-"));
    await file.saveAs(path.join(folder, "frames.npz"));
    const program = await rendered.getByLabel("How Python loads them").inputValue();
    assert.match(execFileSync(PYTHON, ["-c", program], { cwd: folder, encoding: "utf8" }), /'bmode'.*\(\d+, 256, 256\)/);
    rmSync(folder, { recursive: true });
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "job-rendered");
    assert.deepEqual(page.faults, []);
  });

  it("leads smoothly through keyframes, and becomes a film", async () => {
    const { page } = await openScan(at);
    const keyframe = page.getByRole("button", { name: "Add keyframe" });
    for (const y of [-10, 0, 10]) {
      await type(page, "Position Y, mm", String(y));
      if (y === 0) await type(page, "Rotate, about z, °", "20").catch(() => undefined);
      await keyframe.click();
    }
    await page.getByLabel("Seconds between").fill("0.5");
    await page.getByLabel("Seconds between").press("Enter");
    await page.getByTestId("path-summary").getByText("31 poses").waitFor();
    await page.getByTestId("place").getByText("pose 31 of 31").waitFor(); // the probe stays where it was
    await page.getByLabel("Save poses", { exact: true }).selectOption("json");
    const [poses] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: "Save poses" }).click()]);
    const saved = JSON.parse(readFileSync(await poses.path()));
    const ys = saved.poses.map(({ position_mm }) => position_mm.y);
    assert.deepEqual([ys[0], ys[15], ys[30]].map(Math.round), [-10, 0, 10]);
    assert.ok(ys.every((y, i) => i === 0 || y > ys[i - 1]), "it goes back");
    const steps = ys.slice(1).map((y, i) => y - ys[i]);
    assert.ok(Math.max(...steps.slice(1).map((step, i) => Math.abs(step - steps[i]))) < 0.2, "it jerks");
    await picture(page, "path-keyframes");
    const [film] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: "Save as film" }).click()]);
    assert.match(film.suggestedFilename(), /^3 keyframes\.(webm|mp4)$/);
    const bytes = readFileSync(await film.path());
    assert.ok(bytes.length > 2000, `${bytes.length} bytes`);
    assert.ok(bytes.subarray(0, 4).equals(Buffer.from([0x1a, 0x45, 0xdf, 0xa3])) || bytes.subarray(4, 8).toString() === "ftyp", "no video");
    await page.getByRole("button", { name: "Without the last keyframe" }).click();
    await page.getByTestId("path-summary").getByText("16 poses").waitFor();
    assert.deepEqual(page.faults, []);
  });

  it("says what is wrong with a file until the person goes on", async () => {
    const { page } = await openScan(at);
    await load(page, "broken.tum", "0 1 2 3\n");
    const problem = page.getByText("broken.tum: Line 1");
    await problem.waitFor();
    await page.getByLabel("Place in the training sweep").fill("3");
    await problem.waitFor({ state: "detached" });
    await load(page, "broken.tum", "0 1 2 3\n");
    await page.getByRole("alert").filter({ has: problem }).getByRole("button", { name: "Close" }).click();
    await problem.waitFor({ state: "detached" });
  });
});
