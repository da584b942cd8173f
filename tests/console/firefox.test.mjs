/** The console in Debian's Firefox: every view opens, an image comes and follows, the policy of the page holds. */

import assert from "node:assert/strict";
import { mkdirSync } from "node:fs";
import path from "node:path";
import { after, before, describe, it } from "node:test";

import { launchFirefox, missing, openInFirefox, OWN_FONT, resize, stateInFirefox } from "./firefox.mjs";
import { SCREENSHOTS, Service, until } from "./harness.mjs";

const IMAGE = '[aria-label="Live image"]';
const VIEWS = {
  "#/maps/demo": '[data-testid="map-echo"] canvas',
  "#/compare/demo": "main h1 ~ *",
  "#/train": 'input[type="file"]',
  "#/scenes": '[data-testid="frames-rendered"]',
};

describe("in Firefox", { skip: missing ?? false }, () => {
  const at = {};
  before(async () => {
    at.service = await Service.start();
    at.browser = await launchFirefox();
  });
  after(async () => {
    await at.browser?.close();
    await at.service?.stop();
  });

  /** What went wrong but for what this machine lacks: without a graphics card Firefox has no WebGL, and says so. */
  const faultsOf = (page) => page.faults.filter((fault) => !/webgl/i.test(fault));

  /** What the policy kept out, but for a font of Firefox's own style sheet for HTML. */
  async function refusedSources(page) {
    const refused = await page.evaluate(() => globalThis.refusedSources);
    return refused.filter((source) => !OWN_FONT.test(source));
  }

  async function photograph(page, name) {
    mkdirSync(SCREENSHOTS, { recursive: true });
    await page.screenshot({ path: path.join(SCREENSHOTS, `firefox-${name}.png`) });
  }

  it("an image comes, and follows sliders and keys", async () => {
    const page = await openInFirefox(at, "#/scan/demo");
    const first = await until(() => stateInFirefox(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    await page.$eval('input[type="range"][aria-label="Position Y"]', (slider) => {
      slider.value = "3";
      slider.dispatchEvent(new Event("input", { bubbles: true }));
    });
    const moved = await until(() => stateInFirefox(page, IMAGE), ({ print }) => print !== first.print, "the slider does nothing");
    await page.focus(IMAGE);
    await page.keyboard.down("ArrowRight");
    await until(() => stateInFirefox(page, IMAGE), ({ print }) => print !== moved.print, "the arrow keys do nothing");
    await page.keyboard.up("ArrowRight");
    await photograph(page, "scan");
    assert.deepEqual([faultsOf(page), page.foreign, await refusedSources(page)], [[], [], []]);
    await page.close();
  });

  for (const [hash, whole] of Object.entries(VIEWS))
    it(`${hash} opens`, async () => {
      const page = await openInFirefox(at, hash);
      await page.waitForSelector(whole);
      await page.waitForSelector('[data-testid="service-status"].ready');
      await photograph(page, hash.split("/")[1]);
      assert.deepEqual([faultsOf(page), page.foreign, await refusedSources(page)], [[], [], []]);
      await page.close();
    });

  it("the menus open, and a view is chosen from the one of a narrow page", async () => {
    const page = await openInFirefox(at, "#/scenes");
    await page.waitForSelector('[popovertarget="settings-menu"]');
    await page.click('[popovertarget="settings-menu"]');
    await page.waitForSelector('[data-testid="release"]', { visible: true });
    await resize(page, { width: 390, height: 844 });
    await page.waitForSelector('[popovertarget="views-menu"]');
    await page.click('[popovertarget="views-menu"]');
    await page.waitForSelector('#views-menu a[href^="#/maps"]', { visible: true });
    await page.click('#views-menu a[href^="#/maps"]');
    await until(() => stateInFirefox(page, '[data-testid="map-bmode"]'), ({ mean }) => mean > 1, "no map came");
    assert.deepEqual(faultsOf(page), []);
    await page.close();
  });
});
