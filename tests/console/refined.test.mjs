/** A scene with a beam, corrected poses and an uncertainty: its slice, the map of its uncertainty, its corrections. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { describe, it } from "node:test";

import { canvasState, goTo, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { changed, IMAGE, openScan } from "./scan_page.mjs";
import { put } from "./sweep.mjs";
import { tested } from "./tested.mjs";

const UNCERTAINTY = '[data-testid="map-uncertainty"]';
const PHONE = { width: 390, height: 844 };

const at = tested({
  sweep: true,
  prepare: ({ service, files }) =>
    put(service, "/v1/scenes/refined", readFileSync(files.refined), "application/octet-stream"),
});

async function openMaps(options) {
  const page = await openPage(at, "#/maps/refined", options);
  await until(() => canvasState(page, UNCERTAINTY), ({ width }) => width === 256, "no uncertainty came");
  return page;
}

/** Whether the page, or a part of it that scrolls, is wider than what shows it. */
function tooWide(page) {
  return page.evaluate(() => [...document.querySelectorAll("*")]
    .filter((one) => ["auto", "scroll", "hidden"].includes(getComputedStyle(one).overflowX) || one === document.documentElement)
    .filter((one) => one.wrap !== "off") // a program, whose lines are not broken
    .filter((one) => one.clientWidth > 1 && one.scrollWidth > one.clientWidth + 1 && getComputedStyle(one).textOverflow !== "ellipsis")
    .map((one) => one.className || one.localName));
}

describe("the slice", () => {
  it("says what it is, changes the image, and is as trained again where its slider is put there", async () => {
    const { page, first } = await openScan(at, { scene: "refined" });
    const slider = page.getByLabel("Slice thickness", { exact: true });
    const number = page.getByLabel("Slice thickness, mm");
    assert.equal(await number.inputValue(), "3.3");
    await page.getByTitle(/width at half maximum.*As trained: 3\.3 mm/).waitFor();
    await slider.fill("0");
    const thin = await changed(page, first.print);
    await slider.fill("10");
    await changed(page, thin.print);
    await slider.fill("3.3");
    await until(() => canvasState(page, IMAGE), ({ print }) => print === first.print, "it is not as trained");
    for (const typed of ["-3", "50", ""]) {
      await number.fill(typed);
      await number.press("Tab");
      await page.getByText("This takes a number from 0 to 10 mm.").waitFor();
      assert.equal(await number.getAttribute("aria-invalid"), "true", `${typed} was taken`);
      assert.equal(await number.inputValue(), typed, `${typed} was changed in silence`);
      await number.press("Escape");
      assert.equal(await number.inputValue(), "3.3");
    }
    assert.equal((await canvasState(page, IMAGE)).print, first.print, "something was taken");
  });

  it("of a job can be left to the scene again after one was given", async () => {
    const page = await openPage(at, "#/train?show=render");
    const number = page.getByLabel("Slice thickness, mm");
    for (const typed of ["2.5", ""]) {
      await number.fill(typed);
      await number.press("Tab");
      assert.equal(await number.inputValue(), typed);
    }
    assert.equal(await page.getByRole("slider", { name: "Slice thickness" }).count(), 0);
  });

  it("can be as thick as the scene was trained with, however thick that is", async () => {
    const { page } = await openScan(at, { scene: "refined" });
    await page.route(/\/v1\/scenes\/refined$/, async (route) => {
      const scene = await (await route.fetch()).json();
      await route.fulfill({ json: { ...scene, beam: { ...scene.beam, thickness_mm: 12.4 } } });
    });
    await page.reload();
    const slider = page.getByLabel("Slice thickness", { exact: true });
    await until(() => slider.inputValue(), (value) => value === "12.4", "the slider ends before");
  });
});

describe("the map of uncertainty", () => {
  it("has colours that tell small values apart, and says where they end", async () => {
    const page = await openMaps();
    const map = page.locator(UNCERTAINTY);
    await page.getByRole("button", { name: "Uncertainty, show large" }).click();
    await map.getByText("≥ 0.3", { exact: true }).waitFor();
    const brightest = await map.locator("canvas").first().evaluate((canvas) => {
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      return Math.max(...data.filter((_, i) => i % 4 === 0));
    });
    assert.ok(brightest > 60, `nothing brighter than ${brightest}`); // as a share of white it would be half as bright
    await map.locator("svg.overlay").click();
    const value = Number(await page.getByTestId("value-uncertainty").textContent());
    assert.ok(value > 0 && value < 0.3, `${value}`);
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });
});

describe("corrected poses", () => {
  it("are plotted in sight, with the values of the view, and a click goes to a view", async () => {
    const page = await openMaps({ width: 1440, height: 900 });
    const panel = page.getByRole("region", { name: "Corrected poses" });
    for (const title of ["Shift in mm", "Turn in °"]) {
      const box = await panel.getByRole("img", { name: title }).boundingBox();
      assert.ok(box.y + box.height <= 900 && box.x + box.width <= 1440, `${title} is out of sight`);
    }
    await until(() => panel.innerText(), (text) => text.includes("training view 106"), "not the view that the bar of the sweep says");
    await panel.getByText("1.05", { exact: true }).waitFor();
    await page.getByLabel("Place in the training sweep").fill("10");
    await panel.getByText("training view 11").first().waitFor();
    const chart = panel.getByRole("img", { name: "Shift in mm" });
    const box = await chart.boundingBox();
    await chart.click({ position: { x: box.width - 10, y: 30 } }); // beside the last one
    await page.getByText("view 211 of 211", { exact: true }).waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "maps-refined");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });
});

describe("a phone", () => {
  it("shows Scan and Maps without anything beside the screen", async () => {
    const { page } = await openScan(at, { scene: "refined", ...PHONE });
    assert.deepEqual(await tooWide(page), []);
    await picture(page, "scan-phone");
    await goTo(page, "Maps");
    await until(() => canvasState(page, UNCERTAINTY), ({ width }) => width === 256, "no uncertainty came");
    assert.deepEqual(await tooWide(page), []);
    await page.getByRole("img", { name: "Turn in °" }).click({ trial: true }); // nothing lies over it
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "maps-phone");
  });
});
