/** What the 3D view shows: sides, anatomy, what it keeps, contact. How soon a click shows is measured by `make bench-console`. */

import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import path from "node:path";
import { describe, it } from "node:test";

import { watchDrawing } from "./drawing.mjs";
import { canvasState, picture, PYTHON, ROOT, SOURCES, until } from "./harness.mjs";
import { enterPose, IMAGE, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const at = tested({
  prepare: ({ service }) => {
    const script = path.join(ROOT, "tests/console/turned_scene.py");
    const demo = path.join(ROOT, "model/ultragray/phantom/spine.ugr");
    for (const [name, angles] of Object.entries({ upside: ["0", "0", "180"], lying: ["0", "90", "30"] })) {
      const environment = { ...process.env, PYTHONPATH: SOURCES };
      execFileSync(PYTHON, [script, demo, path.join(service.data, `${name}.ugr`), ...angles], { env: environment });
    }
  },
});

async function openRoom(options = {}) {
  const { page } = await openScan(at, { init: `(${watchDrawing})()`, ...options });
  const room = page.getByTestId("room");
  await room.locator("canvas").waitFor();
  await page.getByTestId("legend").waitFor();
  await rest(page);
  return { page, room };
}

/** Waits until the volume is made and nothing is drawn for a second. */
async function rest(page) {
  await page.getByText("refining …").waitFor({ state: "detached" });
  let before = -1;
  const quiet = (count) => count === before || ((before = count), false);
  for (let times = 0; times < 2; times++)
    await until(
      async () => {
        await page.waitForTimeout(500);
        return page.evaluate(() => globalThis.drawings.length);
      },
      quiet,
      "the 3D view does not come to rest",
    );
}

/** The grey of the pixels of the 3D view, and where they have the yellow of the outline of the image. */
function seen(page) {
  return page.getByTestId("room").locator("canvas").evaluate((canvas) => {
    const { width, height } = canvas;
    const copy = new OffscreenCanvas(width, height).getContext("2d");
    copy.drawImage(canvas, 0, 0);
    const { data } = copy.getImageData(0, 0, width, height);
    const box = { left: width, right: 0, top: height, bottom: 0 };
    const grey = [];
    let [bone, vessel] = [0, 0];
    for (let i = 0; i < width * height; i++) {
      const [r, g, b] = data.subarray(4 * i, 4 * i + 3);
      grey.push(r);
      if (r > 200 && g > 150 && g < 225 && b > 40 && b < 110) {
        const [x, y] = [i % width, Math.floor(i / width)];
        box.left = Math.min(box.left, x);
        box.right = Math.max(box.right, x);
        box.top = Math.min(box.top, y);
        box.bottom = Math.max(box.bottom, y);
      }
      if (r > 90 && g > 80 && b > 65 && r > b + 12) bone += 1;
      if (b > 90 && b > g + 20 && g > r + 5) vessel += 1;
    }
    return { width, height, grey, box, bone: bone / (width * height), vessel: vessel / (width * height) };
  });
}

/** How much brighter the right half of a box of grey pixels is than its left half. */
function lean({ grey, width }, { left, right, top, bottom }) {
  const mean = (from, to) => {
    let [sum, count] = [0, 0];
    for (let y = Math.ceil(top + 0.35 * (bottom - top)); y < bottom - 3; y++)
      for (let x = Math.ceil(from); x < to; x++, count++) sum += grey[y * width + x];
    return sum / count;
  };
  const middle = (left + right) / 2;
  const margin = 0.05 * (right - left);
  return mean(middle, right - margin) - mean(left + margin, middle);
}

const leanOfImage = (page) =>
  page.locator(`${IMAGE} canvas`).first().evaluate((canvas) => {
    const { width, height } = canvas;
    const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
    return { width, height, grey: Array.from({ length: width * height }, (_, i) => data[4 * i]) };
  }).then((image) => lean(image, { left: 0, right: image.width, top: 0, bottom: image.height }));

const options = async (page) => {
  const button = page.getByRole("button", { name: "Options" });
  if ((await button.getAttribute("aria-expanded")) === "false") await button.click();
};
const shownAs = async (page, form) => {
  await options(page);
  await page.getByLabel("Show", { exact: true }).selectOption(form);
};

describe("left and right", () => {
  for (const scene of ["demo", "upside", "lying"])
    it(`are those of the image: ${scene}`, async () => {
      const { page } = await openRoom({ scene });
      await shownAs(page, "none");
      await page.getByRole("button", { name: "Options" }).click();
      await page.getByRole("button", { name: "Behind", exact: true }).click();
      {
        await page.getByRole("region", { name: "Live image" }).click();
        await page.keyboard.down("ArrowRight"); // half of the image lies beside the scene
        await page.waitForTimeout(1500);
        await page.keyboard.up("ArrowRight");
      }
      await page.waitForTimeout(500);
      await rest(page);
      const flat = await leanOfImage(page);
      assert.ok(Math.abs(flat) > 10, `the image leans by ${flat} only`);
      const first = await seen(page);
      await picture(page, `space-sides-${scene}`);
      const inSpace = lean(first, first.box);
      assert.ok(Math.sign(inSpace) === Math.sign(flat) && Math.abs(inSpace) > 5, `${flat} in the image, ${inSpace} in space`);
      assert.deepEqual(page.faults, []);
    });
});

describe("the scene", () => {
  it("reads as anatomy without a cut: a spine in the middle, with gaps between its vertebrae", async () => {
    const { page } = await openRoom();
    await page.getByRole("button", { name: "Top", exact: true }).click();
    await rest(page);
    await picture(page, "space-top");
    const { grey, width, height } = await seen(page);
    // along the column of the spine it is bright and dark by turns; beside it dark
    const bright = (x, y) => grey[Math.round(y) * width + Math.round(x)] > 110;
    const share = (from, to) => {
      let [count, all] = [0, 0];
      for (let x = from * width; x < to * width; x += 2)
        for (let y = 0.25 * height; y < 0.8 * height; y += 2, all++) count += bright(x, y) ? 1 : 0;
      return count / all;
    };
    const [left, middle, right] = [share(0.02, 0.25), share(0.42, 0.58), share(0.75, 0.98)];
    assert.ok(middle > 0.2 && left < 0.3 * middle && right < 0.3 * middle, `bright: ${left}, ${middle}, ${right}`);
  });

  it("shows its vessels unless they are left out", async () => {
    const { page } = await openRoom();
    await page.getByRole("button", { name: "Side", exact: true }).click();
    await rest(page);
    await picture(page, "space-vessels");
    const { vessel, bone } = await seen(page);
    assert.ok(vessel > 0.002 && bone > 0.02, `${vessel} of the view are vessels, ${bone} bone`);
    await page.getByTestId("legend").getByRole("button", { name: "vessel" }).click();
    await until(() => seen(page), (now) => now.vessel < 0.1 * vessel, "vessels are not left out");
  });

  it("is shown in every form and colour, with a legend of what the scene has", async () => {
    const { page, room } = await openRoom();
    await options(page);
    const colours = await page.getByLabel("Colour", { exact: true }).locator("option").allTextContents();
    assert.deepEqual(colours, ["Label", "Intensity", "Transmittance", "Coverage"]);
    const legend = page.getByTestId("legend");
    for (const name of ["bone", "muscle", "fat", "vessel"]) await legend.getByRole("button", { name }).waitFor();
    for (const form of ["shaded", "maximum", "splats"])
      for (const colour of ["intensity", "label", "transmittance", "coverage"]) {
        const before = (await room.screenshot()).toString("base64");
        await shownAs(page, form);
        await page.getByLabel("Colour", { exact: true }).selectOption(colour);
        if (colour !== "label") assert.match(await legend.textContent(), /\d\.\d\d/);
        await until(async () => (await room.screenshot()).toString("base64") !== before, Boolean, `${form} ${colour}`);
        await rest(page);
        await picture(page, `space-${form}-${colour}`);
      }
    await page.getByLabel("Colour", { exact: true }).selectOption("label");
    const all = (await room.screenshot()).toString("base64");
    await legend.getByRole("button", { name: "bone" }).click();
    await until(async () => (await room.screenshot()).toString("base64") !== all, Boolean, "bone is not left out");
    for (const cut of ["image", "lateral", "elevation", "axial", "x", "y", "z"]) {
      const before = (await room.screenshot()).toString("base64");
      await page.getByLabel("Cut", { exact: true }).selectOption(cut);
      await until(async () => (await room.screenshot()).toString("base64") !== before, Boolean, `cut ${cut}`);
    }
    assert.deepEqual(page.faults, []);
  });

  it("keeps what was chosen and from where it is looked at, in other views and over a reload", async () => {
    const { page, room } = await openRoom();
    await shownAs(page, "splats");
    await page.getByRole("button", { name: "Turn", exact: true }).click();
    const box = await room.boundingBox();
    await page.mouse.move(box.x + 60, box.y + box.height - 80);
    await page.mouse.down();
    await page.mouse.move(box.x + 160, box.y + box.height - 120, { steps: 5 });
    await page.mouse.up();
    await rest(page);
    const chosen = async () => ({
      form: await page.getByLabel("Show", { exact: true }).inputValue(),
      turn: await page.getByRole("button", { name: "Turn", exact: true }).getAttribute("aria-pressed"),
      views: await page.getByRole("group", { name: "Look from" }).locator("[aria-pressed=true]").count(),
    });
    const before = await chosen();
    assert.deepEqual(before, { form: "splats", turn: "true", views: 0 });
    const { box: outline } = await seen(page);
    const same = async (what) => {
      await page.getByTestId("legend").waitFor();
      await rest(page);
      assert.deepEqual(await chosen(), before, what);
      const { box: now } = await seen(page);
      for (const side of ["left", "right", "bottom"])
        assert.ok(Math.abs(now[side] - outline[side]) < 12, `${what}: ${JSON.stringify(now)} was ${JSON.stringify(outline)}`);
    };
    await page.getByRole("link", { name: "Maps", exact: true }).click();
    await page.getByTestId("cursor-lateral").waitFor();
    await page.getByRole("link", { name: "Scan", exact: true }).click();
    await same("after Maps");
    await page.reload();
    await same("after a reload");
  });

  it("is turned by keys of its own, which do not steer the probe", async () => {
    const { page, room } = await openRoom();
    const pose = await poseOf(page);
    await page.getByTestId("space").focus();
    const before = (await room.screenshot()).toString("base64");
    await page.keyboard.press("ArrowLeft");
    await page.keyboard.press("ArrowUp");
    await page.keyboard.press("+");
    await until(async () => (await room.screenshot()).toString("base64") !== before, Boolean, "the view is not turned");
    assert.deepEqual(await poseOf(page), pose);
  });
});

describe("contact", () => {
  it("keeps the face on the skin, and tells how far it is pressed", async () => {
    const { page } = await openRoom();
    const height = async () => (await poseOf(page)).position_mm.z;
    await page.getByRole("checkbox", { name: "Contact" }).check();
    await page.getByRole("region", { name: "Live image" }).click();
    await page.evaluate(() => document.activeElement.blur());
    const start = await poseOf(page);
    await page.keyboard.press("PageUp"); // it would lift off
    await page.waitForTimeout(300);
    assert.ok(Math.abs((await height()) - start.position_mm.z) < 0.3, "it lifted off");
    await page.keyboard.down("PageDown");
    await page.waitForTimeout(300);
    await page.keyboard.up("PageDown");
    await until(height, (z) => z > start.position_mm.z + 1, "it is not pressed");
    await page.getByTestId("pressed").waitFor();
    await page.waitForTimeout(1000);
    const pressed = await height();
    await page.keyboard.down("ArrowRight");
    await page.waitForTimeout(500);
    await page.keyboard.up("ArrowRight");
    const { position_mm } = await until(() => poseOf(page), (now) => now.position_mm.x !== start.position_mm.x, "it did not slide");
    assert.ok(Math.abs(position_mm.z - pressed) < 0.6, `${position_mm.z} mm, not ${pressed} mm deep`);
    await picture(page, "space-contact");
    assert.deepEqual(page.faults, []);
  });

  it("is where the probe is dragged by its body, or put by a double click on the skin", async () => {
    const { page, room } = await openRoom();
    await page.getByRole("checkbox", { name: "Contact" }).check();
    await page.getByRole("button", { name: "Top", exact: true }).click();
    await rest(page);
    const before = await poseOf(page);
    const box = await room.boundingBox();
    await page.mouse.dblclick(box.x + box.width * 0.5, box.y + box.height * 0.75);
    const moved = await until(() => poseOf(page), (now) => Math.abs(now.position_mm.y - before.position_mm.y) > 5, "it was not put there");
    assert.ok(Math.abs(moved.position_mm.z) < 1, `${moved.position_mm.z} mm over the skin`);
    const canvas = room.locator("canvas");
    let held = null;
    for (let y = 0.3; y < 0.95 && held === null; y += 0.02)
      for (let x = 0.3; x < 0.7 && held === null; x += 0.02) {
        await page.mouse.move(box.x + box.width * x, box.y + box.height * y);
        if ((await canvas.evaluate(({ style }) => style.cursor)) === "move") held = [box.x + box.width * x, box.y + box.height * y];
      }
    assert.ok(held, "the body cannot be taken");
    await page.mouse.down();
    await page.mouse.move(held[0] + 10, held[1] - 60, { steps: 5 });
    await page.mouse.up();
    const dragged = await until(() => poseOf(page), (now) => Math.abs(now.position_mm.y - moved.position_mm.y) > 3, "it was not dragged");
    assert.ok(Math.abs(dragged.position_mm.z) < 1, `${dragged.position_mm.z} mm over the skin`);
  });
});

it("says where the browser has no WebGL, and scans all the same", async () => {
  const without = () => {
    const { getContext } = HTMLCanvasElement.prototype;
    HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
      return kind.startsWith("webgl") ? null : getContext.call(this, kind, ...rest);
    };
  };
  const { page } = await openScan(at, { init: `(${without})()` });
  await page.getByText("The 3D view needs WebGL").waitFor();
  const { print } = await canvasState(page, IMAGE);
  await enterPose(page, JSON.stringify({ position_mm: { x: 0, y: 10, z: 0 }, quaternion: { w: 1, x: 0, y: 0, z: 0 } }));
  await until(() => canvasState(page, IMAGE), (state) => state.print !== print, "no image without WebGL");
});
