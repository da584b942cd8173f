/** Every view, light and dark, at every size: what axe finds, what is cut, what fingers and the keyboard alone can reach. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { canvasState, laidOut, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { cut, small, unreachable, walk } from "./reach.mjs";
import { tested } from "./tested.mjs";

const at = tested({ environment: { ULTRAGRAY_EMBEDDED_WORKER: "true" }, sweep: true });

/** Addresses, and what is there once a view is whole. */
const VIEWS = {
  scan: ["#/scan/demo", (page) => until(() => canvasState(page, '[aria-label="Live image"]'), ({ mean }) => mean > 5, "no frame")],
  maps: ["#/maps/demo", (page) => until(() => canvasState(page, '[data-testid="map-echo"]'), ({ mean }) => mean > 1, "no map")],
  compare: ["#/compare/demo", (page) => page.getByRole("main").getByRole("heading").first().waitFor({ state: "attached" })],
  train: ["#/train", (page) => page.getByText("Add a sweep", { exact: true }).waitFor()],
  scenes: ["#/scenes", (page) => page.getByTestId("frames-rendered").waitFor()],
};
const LARGE = { width: 1280, height: 800 };
const ZOOMED = { width: 640, height: 400 }; // the same window at 200 %
const SIZES = { "200 %": ZOOMED, phone: { width: 390, height: 844 }, upright: { width: 768, height: 1024 }, tablet: { width: 1024, height: 768 } };

async function open(view, options) {
  const [hash, whole] = VIEWS[view];
  const page = await openPage(at, hash, options);
  await whole(page);
  await page.getByText("Service ready").first().waitFor({ state: "attached" });
  return page;
}

for (const view of Object.keys(VIEWS)) {
  describe(view, () => {
    for (const scheme of ["light", "dark"])
      it(`has nothing that axe objects to, ${scheme}, at 100 % and 200 %`, async () => {
        const page = await open(view, { ...LARGE, scheme });
        assert.deepEqual(await seriousFindings(page), [], "at 100 %");
        await page.setViewportSize(ZOOMED);
        await laidOut(page);
        assert.deepEqual(await seriousFindings(page), [], "at 200 %");
        assert.deepEqual([page.faults, page.foreign], [[], []]);
      });

    it("cuts nothing at any size", async () => {
      const page = await open(view, LARGE);
      const found = { "100 %": [await cut(page), await unreachable(page)] };
      for (const [name, size] of Object.entries(SIZES)) {
        await page.setViewportSize(size);
        await laidOut(page);
        found[name] = [await cut(page), await unreachable(page)];
        await picture(page, `size-${view}-${name.replace(/\W+/g, "")}`);
      }
      assert.deepEqual(found, Object.fromEntries(Object.keys(found).map((name) => [name, [[], []]])));
    });

    it("has room for fingers", async () => {
      const page = await open(view, { width: 1024, height: 768, touch: true });
      assert.deepEqual(await small(page, 44), []);
      await picture(page, `touch-${view}`);
    });

    it("is walked through by keyboard alone", async () => {
      const page = await open(view, LARGE);
      assert.deepEqual(await walk(page), []);
    });
  });
}

describe("a phone", () => {
  it("shows a large image, with one line over it", async () => {
    const page = await openPage(at, "#/scan/demo", { width: 390, height: 844, touch: true });
    await VIEWS.scan[1](page);
    const { width } = await page.locator('[aria-label="Live image"] canvas').first().boundingBox();
    assert.ok(width > 0.8 * 390, `the image is ${width} of 390 pixels wide`);
    const badge = await page.getByTestId("confidence-badge").boundingBox();
    assert.ok(badge.height < 24, `the words over it are ${badge.height} pixels high`);
    await picture(page, "phone-scan");
  });
});
