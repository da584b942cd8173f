/** The header and what every view shares: menus, language, colours, sliders. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { focused, goTo, laidOut, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const at = tested();

describe("the header", () => {
  for (const [width, height] of [[768, 1024], [640, 400], [390, 844]])
    it(`is whole at ${width} px, its views below a button that keys work`, async () => {
      const page = await openPage(at, "#/scenes", { width, height });
      await page.getByTestId("frames-rendered").waitFor();
      const header = await page.getByRole("banner").evaluate((one) => [one.scrollWidth <= one.clientWidth, one.clientHeight]);
      assert.deepEqual(header, [true, header[1]], "something is cut");
      assert.ok(header[1] < 60, "it wraps");
      const menu = page.getByRole("button", { name: /^Views:/ });
      await menu.focus();
      await page.keyboard.press("Enter");
      assert.deepEqual(await seriousFindings(page), []);
      await page.keyboard.press("Tab");
      assert.equal(await focused(page), "Scan");
      await page.keyboard.press("Escape");
      await page.getByRole("link", { name: "Train", exact: true }).waitFor({ state: "hidden" });
      await goTo(page, "Train");
      await page.getByText("Add a sweep", { exact: true }).waitFor();
      await page.getByRole("navigation", { name: "Views" }).waitFor({ state: "hidden" });
      assert.deepEqual(page.faults, []);
    });

  it("keeps language and colours, and tells release, renderer and documents", async () => {
    const { page } = await openScan(at);
    await page.getByRole("button", { name: "Settings" }).click();
    const menu = page.getByRole("group", { name: "Settings" });
    await until(() => menu.getByTestId("release").textContent(), (text) => /^\d+\.\d+/.test(text), "no release");
    await until(() => menu.getByTestId("renderer").textContent(), (text) => /^cpu/.test(text), "no renderer");
    assert.equal(await menu.getByRole("link", { name: "Documentation of the API" }).getAttribute("href"), "/docs");
    assert.deepEqual(await seriousFindings(page), []);
    await menu.getByRole("button", { name: "Dark" }).click();
    await menu.getByLabel("Language").selectOption("de");
    await page.getByRole("link", { name: "Schallen", exact: true }).waitFor();
    await picture(page, "settings-german");
    await page.reload();
    await page.getByRole("link", { name: "Karten", exact: true }).waitFor();
    assert.deepEqual(await page.evaluate(() => [document.documentElement.lang, document.documentElement.dataset.theme]), ["de", "dark"]);
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });
});

describe("a page that is older than the service", () => {
  it("offers to load itself again where a part of it is not there any more", async () => {
    const { page } = await openScan(at);
    await page.route(/\/assets\/Compare-.*\.js$/, (route) => route.fulfill({ status: 404, body: "" }));
    await goTo(page, "Compare");
    const notice = page.getByRole("alert").filter({ hasText: "The service may have been renewed" });
    await notice.waitFor();
    await picture(page, "outdated");
    await page.unroute(/\/assets\/Compare-.*\.js$/);
    await Promise.all([page.waitForEvent("load"), notice.getByRole("button", { name: "Reload" }).click()]);
    await page.getByLabel("Compare the truth with").or(page.getByText(/held-out frames/)).first().waitFor();
    assert.equal(await notice.count(), 0);
  });
});

describe("a console that nobody has set", () => {
  it("speaks the first of the browser's languages that it knows", async () => {
    for (const [locale, view] of [["de-AT", "Karten"], ["fr-FR", "Maps"]]) {
      const page = await openPage(at, "", { locale });
      await page.getByRole("link", { name: view, exact: true }).waitFor();
    }
  });
});

describe("a slider", () => {
  it("says what it takes where something else is typed, and takes nothing of it", async () => {
    const { page } = await openScan(at);
    const gain = page.getByLabel("Gain, dB");
    await gain.fill("300");
    await gain.press("Tab");
    await page.getByRole("alert").getByText("This takes a number from -30 to 30 dB.").waitFor();
    assert.deepEqual([await gain.inputValue(), await gain.getAttribute("aria-invalid")], ["300", "true"]);
    assert.equal(await page.getByRole("slider", { name: "Gain", exact: true }).inputValue(), "0");
    assert.deepEqual(await seriousFindings(page), []);
    await gain.fill("12");
    await gain.press("Tab");
    await page.getByText("This takes a number").waitFor({ state: "detached" });
    assert.equal(await page.getByRole("slider", { name: "Gain", exact: true }).inputValue(), "12");
  });

  it("stays at 0 near it, steps finely by keys, and goes back by a double click", async () => {
    const { page } = await openScan(at);
    const tilt = page.getByRole("slider", { name: /^Tilt/ });
    await tilt.scrollIntoViewIfNeeded();
    const { x, y, width, height } = await tilt.boundingBox();
    const middle = y + height / 2;
    await page.mouse.move(x + width / 2, middle);
    await page.mouse.down();
    await page.mouse.move(x + width * 0.7, middle, { steps: 4 });
    await until(() => tilt.inputValue(), (value) => Number(value) > 5, "it does not follow");
    await page.mouse.move(x + width / 2 + 1.2, middle, { steps: 4 });
    await page.mouse.up();
    await until(() => tilt.inputValue(), (value) => Number(value) === 0, "it does not stay at 0");
    await tilt.press("ArrowRight");
    await until(() => tilt.inputValue(), (value) => Number(value) > 0, "keys do not leave 0");
    await page.mouse.dblclick(x + width * 0.8, middle);
    await until(() => tilt.inputValue(), (value) => Number(value) === 0, "a double click does not bring it back");
    const gain = page.getByRole("slider", { name: "Gain", exact: true });
    await gain.evaluate((slider) => {
      slider.valueAsNumber = 12;
      for (const type of ["input", "dblclick"]) slider.dispatchEvent(new Event(type, { bubbles: true })); // back before it was drawn
    });
    await laidOut(page);
    assert.equal(await gain.inputValue(), "0", "the slider stays where the gain is not");
    assert.ok((await poseOf(page)).quaternion.w > 0.99);
  });
});
