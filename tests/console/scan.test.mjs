/** Scan: frames come, follow the probe and the controls, and what stands in the way is said. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { canvasState, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { changed, dragProbe, enterPose, IMAGE, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const at = tested();

describe("scan", () => {
  it("is the page at the address of the service, with the first scene", async () => {
    const page = await openPage(at, "");
    await until(() => page.url(), (url) => url.endsWith("#/scan/demo"), "no scene was chosen");
    await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
  });

  it("shows the frame of where the probe is, and follows keys, sliders and JSON", async () => {
    const { page, first } = await openScan(at);
    assert.deepEqual([first.width, first.height], [256, 256]);
    const pose = await poseOf(page);
    await page.locator(`${IMAGE} .steer`).focus();
    await page.keyboard.down("ArrowDown");
    const moved = await changed(page, first.print);
    await page.keyboard.up("ArrowDown");
    await until(() => poseOf(page), ({ position_mm }) => position_mm.y > pose.position_mm.y, "it did not slide");
    await page.keyboard.press("Shift+ArrowRight");
    await until(() => poseOf(page), ({ quaternion }) => quaternion.z !== pose.quaternion.z, "it did not turn");
    await page.getByLabel("Position X", { exact: true }).fill("8");
    await until(() => poseOf(page), ({ position_mm }) => position_mm.x === 8, "the slider did not move it");
    await changed(page, moved.print);
    await enterPose(page, JSON.stringify(pose));
    const back = ({ mean }) => Math.abs(mean - first.mean) < 0.05; // the pose is rounded to micrometres
    await until(() => canvasState(page, IMAGE), back, "the first image did not come back");
    await enterPose(page, '{"position_mm": {"x": 1}}');
    await page.getByText("position_mm needs the numbers x, y, z.").waitFor();
    await page.getByLabel("Pose as JSON, Enter applies").press("Escape");
    await page.getByLabel("Copy the pose as JSON").click();
    assert.deepEqual(JSON.parse(await page.evaluate(() => navigator.clipboard.readText())), pose);
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("shows what gain, range, TGC, depth, flip, samples and another probe make of it", async () => {
    const { page, first } = await openScan(at);
    await page.getByLabel("Gain", { exact: true }).fill("12");
    const brighter = await changed(page, first.print);
    assert.ok(brighter.mean > first.mean + 10, `${brighter.mean} after ${first.mean}`);
    await page.getByLabel("Time-gain compensation 6 of 6, dB").fill("20");
    const deep = await changed(page, brighter.print);
    assert.ok(deep.mean > brighter.mean);
    await page.getByRole("button", { name: "Reset" }).click();
    await until(() => canvasState(page, IMAGE), ({ print }) => print === first.print, "Reset did not reset");
    await page.getByLabel("Depth", { exact: true }).fill("30");
    await until(() => canvasState(page, IMAGE), ({ height }) => height === 128, "the depth is not half of it");
    await page.getByRole("button", { name: "Reset" }).click();
    await until(() => canvasState(page, IMAGE), ({ print }) => print === first.print, "the depth stayed");
    await page.getByLabel("Slice thickness", { exact: true }).fill("8");
    await changed(page, first.print);
    await page.getByRole("button", { name: "Reset" }).click();
    await page.getByLabel("Flip").check();
    await page.locator('[data-testid="orientation-marker"][data-side="right"]').waitFor();
    await page.getByRole("combobox", { name: "Image size" }).selectOption("512");
    await until(() => canvasState(page, IMAGE), ({ width }) => width === 512, "no 512 scan lines");
    await page.getByRole("combobox", { name: "Probe" }).selectOption("convex");
    await until(() => canvasState(page, IMAGE), ({ width }) => width === 640, "no sector came");
    await until(() => poseOf(page), ({ position_mm }) => position_mm.z < -30, "the face of the convex probe left the skin");
    await picture(page, "scan-convex");
    await page.getByRole("button", { name: "Scan lines" }).click();
    await until(() => canvasState(page, IMAGE), ({ width }) => width === 512, "no scan lines came");
  });

  it("snaps to training views, plays them, and says how far the view is from them", async () => {
    const { page, first } = await openScan(at);
    const confidence = page.getByTestId("confidence");
    await until(() => confidence.textContent(), (text) => text === "Well supported", "home is a training view");
    await page.getByLabel("Tilt, about the lateral axis", { exact: true }).fill("60");
    await until(() => confidence.textContent(), (text) => text !== "Well supported", "60 degrees are none");
    await page.getByRole("button", { name: "Snap" }).click();
    await until(() => confidence.textContent(), (text) => text === "Well supported", "it did not snap");
    await page.getByRole("button", { name: "Home" }).click();
    await until(() => canvasState(page, IMAGE), ({ print }) => print === first.print, "home did not come back");
    await page.getByRole("button", { name: "Play the sweep" }).click();
    const playing = await changed(page, first.print);
    await changed(page, playing.print);
    await page.getByRole("button", { name: "Pause the sweep" }).click();
  });

  it("is steered by a gamepad", async () => {
    const { page, first } = await openScan(at);
    await page.evaluate(() => {
      const pad = { id: "Pad of the test", connected: true, axes: [0, 1, 0, 0], buttons: [] };
      navigator.getGamepads = () => [pad];
      dispatchEvent(new Event("gamepadconnected"));
    });
    await page.getByText("Gamepad: Pad of the test").waitFor();
    await changed(page, first.print);
    const slid = ({ position_mm }) => position_mm.y > -15; // it was at -18.9
    await until(() => poseOf(page), slid, "the stick does not slide the probe in elevation");
  });

  it("shows the scene in space, where the probe can be dragged", async () => {
    const { page } = await openScan(at);
    const room = page.getByTestId("room");
    await room.locator("canvas").waitFor();
    await page.getByTestId("legend").waitFor();
    await page.getByText("refining …").waitFor({ state: "detached" });
    const changes = async (change, what) => {
      const before = (await room.screenshot()).toString("base64");
      await change();
      await until(async () => (await room.screenshot()).toString("base64") !== before, Boolean, `${what}: nothing changed`);
      await page.waitForTimeout(500);
    };
    await page.getByRole("button", { name: "Options" }).click();
    await changes(() => page.getByLabel("Cut", { exact: true }).selectOption("image"), "the cut");
    await changes(() => page.getByLabel("Colour", { exact: true }).selectOption("transmittance"), "the colours");
    await picture(page, "scan-cut");
    await changes(() => page.getByLabel("Sweep", { exact: true }).check(), "the sweep");
    await page.getByRole("button", { name: "Options" }).click();
    const pose = await poseOf(page);
    assert.ok(await dragProbe(page, room, pose), "there is no handle where the probe is");
    await picture(page, "scan");
    assert.deepEqual(page.faults, []);
  });

  it("is usable by keyboard and by readers of the screen, at 1280 and at 1024 pixels", async () => {
    for (const [width, height, scheme] of [[1280, 800, "light"], [1024, 768, "dark"]]) {
      const { page } = await openScan(at, { width, height, scheme });
      assert.deepEqual(await seriousFindings(page), []);
      const wider = await page.evaluate(() => document.documentElement.scrollWidth > innerWidth);
      assert.equal(wider, false, `wider than ${width} pixels`);
      await picture(page, `scan-${width}`);
      await page.context().close();
    }
  });

  it("says that the service is down, and goes on when it is back", async () => {
    const { page, first } = await openScan(at);
    await at.service.down();
    await page.getByTestId("service-down").waitFor();
    await page.getByText("No connection").waitFor();
    await picture(page, "scan-down");
    await page.getByLabel("Position Y", { exact: true }).fill("3");
    await at.service.up();
    await page.getByTestId("service-down").waitFor({ state: "detached" });
    await changed(page, first.print);
  });

  it("says that a scene is missing and which there are", async () => {
    const page = await openPage(at, "#/scan/nobody");
    await page.getByTestId("scene-missing").getByText("There is no scene nobody here.").waitFor();
    await picture(page, "scan-missing");
    await page.getByTestId("scene-missing").getByRole("link", { name: "demo" }).click();
    await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
  });
});
