/** Tissue that moves and is pressed in, on the image: a slider for each mode, breathing, and how far the face is pressed in. */

import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import path from "node:path";
import { describe, it } from "node:test";

import { canvasState, picture, PYTHON, seriousFindings, SOURCES, until } from "./harness.mjs";
import { changed, IMAGE, openScan } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const MADE = `
import sys
from ultragray import GaussianScene
from ultragray.learn.motion import add_motion
from ultragray.scene.motion_settings import MotionSettings
add_motion(GaussianScene.load(sys.argv[1]), MotionSettings(chest_mm=8.0)).scene.save(sys.argv[2])
`;
const at = tested({
  prepare: async ({ service: { data } }) => {
    const files = ["demo.ugr", "moving.ugr"].map((name) => path.join(data, name));
    execFileSync(PYTHON, ["-c", MADE, ...files], { env: { ...process.env, PYTHONPATH: SOURCES } });
  },
});

const slider = (page) => page.getByRole("slider", { name: "breathing" });
const breathes = (page) => page.getByRole("checkbox", { name: "Breathes" });

describe("tissue that moves", () => {
  it("has a slider for each mode, which the address keeps, and breathes by the service's clock", async () => {
    const { page, first } = await openScan(at, { scene: "moving" });
    assert.equal(await slider(page).inputValue(), "0");
    await slider(page).fill("1");
    await changed(page, first.print);
    await until(() => page.url(), (url) => url.includes("phase=1"), "the address does not tell it");
    await page.reload();
    await until(() => slider(page).inputValue(), (value) => value === "1", "it is forgotten");

    await breathes(page).check();
    await slider(page).waitFor({ state: "detached" });
    await page.getByRole("slider", { name: "How deeply" }).fill("0.5");
    await until(() => page.url(), (url) => url.includes("breathing=4_0.5") && !url.includes("phase="), "the address does not tell it");
    await page.reload();
    await until(() => breathes(page).isChecked(), (yes) => yes, "it is forgotten");
    const prints = new Set();
    await until(async () => prints.add((await canvasState(page, IMAGE)).print).size, (views) => views > 4, "it holds its breath");
    await breathes(page).scrollIntoViewIfNeeded();
    await picture(page, "motion-breathing");
    assert.deepEqual(await seriousFindings(page), []);

    await breathes(page).uncheck();
    await until(() => slider(page).inputValue(), (value) => value === "0", "it is not at rest");
    await until(() => canvasState(page, IMAGE), ({ print }) => print === first.print, "the image is another one at rest");
    await picture(page, "motion-slider");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("is not offered for a scene that is still, nor a depth without pressure", async () => {
    const { page } = await openScan(at);
    const depth = page.getByRole("spinbutton", { name: "Indentation" });
    assert.deepEqual([await breathes(page).count(), await slider(page).count(), await depth.count()], [0, 0, 0]);
    await page.getByRole("combobox", { name: "Off the skin" }).selectOption({ label: "Dark; pressed tissue gives way" });
    await depth.fill("3");
    await depth.press("Enter");
    await until(() => page.getByTestId("pressed").textContent(), (text) => /^3.0 mm, [\d.]+ N$/.test(text), "it is not pressed in");
    await depth.scrollIntoViewIfNeeded();
    await picture(page, "motion-pressed");
    await page.getByRole("combobox", { name: "Off the skin" }).selectOption({ label: "Contact assumed" });
    await page.getByTestId("pressed").waitFor({ state: "detached" });
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });
});
