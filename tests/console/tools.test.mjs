/** Needles and the like in the image: put there, moved, seen in the image and in space, kept in the address, with labels in Maps. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { canvasState, goTo, picture, seriousFindings, until } from "./harness.mjs";
import { cut, small } from "./reach.mjs";
import { changed, IMAGE, openScan } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const at = tested();
const panelOf = (page) => page.getByRole("region", { name: "Tools in the image" });
const valueOf = (page, label) => page.getByLabel(`${label}, mm`, { exact: true }).inputValue().then(Number);

/** Scan with a needle, and how the image was without it. */
async function openWithNeedle(options) {
  const { page, first } = await openScan(at, options);
  await page.getByRole("button", { name: "Add a needle" }).click();
  const needle = await changed(page, first.print);
  return { page, first, needle };
}

/** How many pixels of the 3D view have the orange of tools. */
async function toolPixels(page) {
  const bytes = [...(await page.getByTestId("room").screenshot())];
  return page.evaluate(async (png) => {
    const bitmap = await createImageBitmap(new Blob([new Uint8Array(png)], { type: "image/png" }));
    const copy = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
    copy.drawImage(bitmap, 0, 0);
    const { data } = copy.getImageData(0, 0, bitmap.width, bitmap.height);
    let count = 0;
    for (let i = 0; i < data.length; i += 4) if (data[i] > 150 && data[i] - data[i + 2] > 70 && data[i] - data[i + 1] > 50) count += 1;
    return count;
  }, bytes);
}

describe("tools in the image", () => {
  it("are put into the image, advanced along their axis, changed by numbers, taken back and removed", async () => {
    const { page, first, needle } = await openWithNeedle();
    assert.ok(needle.mean !== first.mean);
    const seen = page.getByTestId("tool-seen");
    await seen.getByText(/^Tip: in the image, \d+\.\d mm deep$/).waitFor();
    const before = [await valueOf(page, "Tip X"), await valueOf(page, "Tip Z")];
    await page.getByRole("button", { name: "Advance by 5 mm" }).click();
    const advanced = await changed(page, needle.print);
    const after = [await valueOf(page, "Tip X"), await valueOf(page, "Tip Z")];
    assert.ok(Math.abs(Math.hypot(after[0] - before[0], after[1] - before[1]) - 5) < 0.15, `${before} to ${after}`);
    assert.ok(after[0] > before[0] && after[1] > before[1], "it was not advanced towards its tip");
    await page.keyboard.press("Control+z");
    await changed(page, advanced.print);
    assert.deepEqual([await valueOf(page, "Tip X"), await valueOf(page, "Tip Z")], before);

    const y = await valueOf(page, "Tip Y");
    const field = page.getByLabel("Tip Y, mm", { exact: true });
    await field.fill(String(y + 8));
    await field.press("Enter");
    await seen.getByText("Tip: 8.0 mm beside the image").waitFor();
    await until(() => canvasState(page, IMAGE), ({ print }) => print === first.print, "a needle beside the image is seen in it");
    await page.getByRole("button", { name: "To the image", exact: true }).click();
    await until(() => canvasState(page, IMAGE), ({ print }) => print === needle.print, "it did not come back");
    await page.getByRole("button", { name: "Remove", exact: true }).click();
    await until(() => canvasState(page, IMAGE), ({ print }) => print === first.print, "it is still there");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("of every kind are seen in the image and in space, and fit their panel", async () => {
    const { page, needle } = await openWithNeedle();
    await page.getByTestId("legend").waitFor();
    await page.getByText("refining …").waitFor({ state: "detached" });
    const thin = await until(() => toolPixels(page), (count) => count > 20, "no needle in space");
    await picture(page, "tools-needle");
    await page.getByRole("button", { name: "Add a box" }).click();
    const box = await changed(page, needle.print);
    await until(() => toolPixels(page), (count) => count > thin, "no box in space");
    await page.getByLabel("Turn Rotate, °", { exact: true }).fill("20");
    await picture(page, "tools-box");
    await page.getByRole("button", { name: "Add a cylinder" }).click();
    await page.getByText("Look and label").click();
    await page.getByLabel("Diameter, mm").fill("4");
    await page.getByLabel("Diameter, mm").press("Enter");
    await changed(page, box.print);
    assert.deepEqual(await panelOf(page).getByLabel("Tool", { exact: true }).locator("option").allTextContents(), ["1 Needle", "2 Box", "3 Cylinder"]);
    await picture(page, "tools-cylinder");
    assert.deepEqual(await seriousFindings(page), []);
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("come back by the address, with ghosts; what cannot be used in it is told", async () => {
    const { page, needle } = await openWithNeedle();
    await page.getByLabel("Frame of the tool").selectOption("probe");
    await page.getByLabel("Ghost echoes", { exact: true }).fill("0.5");
    await changed(page, needle.print);
    await until(() => page.url(), (url) => url.includes("tool1=needle") && url.includes("tool1.frame=probe") && url.includes("ghost=0.5"), "the address does not tell it");
    const before = await canvasState(page, IMAGE);
    const tip = [await valueOf(page, "Tip Lateral"), await valueOf(page, "Tip Axial")];
    await page.reload();
    await until(() => canvasState(page, IMAGE), ({ print }) => print === before.print, "the image is another");
    assert.deepEqual([await valueOf(page, "Tip Lateral"), await valueOf(page, "Tip Axial")], tip);
    const broken = page.url().replace(/tool1\.tip_mm=[^&]*/, "tool1.tip_mm=1_2");
    await page.goto("about:blank");
    await page.goto(broken);
    await page.getByTestId("link-refused").getByText("tool1.tip_mm=1_2 (3 numbers)").waitFor();
  });

  it("move with the probe where they are held by it, else stay in the scene", async () => {
    const { page, needle } = await openWithNeedle();
    await page.getByLabel("Position Y", { exact: true }).fill("4");
    await page.getByTestId("tool-seen").getByText(/beside the image/).waitFor();
    await changed(page, needle.print);
    await page.getByRole("button", { name: "To the image", exact: true }).click();
    await page.getByLabel("Frame of the tool").selectOption("probe");
    await page.getByLabel("Position Y", { exact: true }).fill("10");
    await page.getByTestId("tool-seen").getByText(/in the image/).waitFor();
  });

  it("stay as they are while the image stands", async () => {
    const { page } = await openWithNeedle();
    await page.keyboard.press("f");
    await panelOf(page).getByText("Frozen: the image keeps its tools.").waitFor();
    assert.ok(await page.getByRole("button", { name: "Add a needle" }).isDisabled());
    assert.ok(await page.getByRole("button", { name: "Advance by 1 mm" }).isDisabled());
  });

  it("have their name among the labels of Maps", async () => {
    const { page } = await openWithNeedle();
    await goTo(page, "Maps");
    await page.getByRole("button", { name: "Labels, show large" }).click();
    await page.getByRole("listitem").getByText("Needle").waitFor();
    await picture(page, "tools-labels");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("have room for fingers on a tablet, and words in German", async () => {
    const { page } = await openWithNeedle({ width: 1024, height: 768, touch: true });
    assert.deepEqual(await small(page, 44), []);
    await page.getByTestId("tool-seen").scrollIntoViewIfNeeded();
    await picture(page, "tools-touch");
    await until(() => page.url(), (url) => url.includes("tool1=needle"), "the address does not hold the needle");
    await page.evaluate(() => localStorage.setItem("ultragray.language", "de"));
    await page.reload();
    await page.getByTestId("tool-seen").getByText(/^Spitze: im Bild, \d+,\d mm tief$/).waitFor();
    await page.getByTestId("tool-seen").scrollIntoViewIfNeeded();
    const tip = page.getByLabel("Spitze X, mm", { exact: true });
    await tip.fill("7,5");
    await tip.press("Enter");
    await tip.press("ArrowUp");
    await until(() => tip.inputValue(), (value) => value === "8,0", "it does not speak German");
    await tip.fill("weit");
    await tip.press("Enter");
    await page.getByRole("alert").getByText("Hier passt nur eine Zahl").waitFor();
    await picture(page, "tools-touch-german");
    assert.deepEqual(await cut(page), []);
  });
});
