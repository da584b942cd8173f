/** A service that asks for a key: the page asks the person, once a tab. */

import assert from "node:assert/strict";
import { after, before, describe, it } from "node:test";

import { canvasState, launch, openPage, picture, seriousFindings, Service, until } from "./harness.mjs";

const KEY = "a-key-of-the-tests";

let service;
let browser;

before(async () => {
  [service, browser] = await Promise.all([Service.start({ ULTRAGRAY_API_KEYS: KEY }), launch()]);
});
after(async () => {
  await browser?.close();
  await service?.stop();
});

describe("a key", () => {
  it("opens the page, the stream included, and is kept over a reload", async () => {
    const page = await openPage(browser, service, "#/scan/demo");
    await page.getByText("This service asks for a key").waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "key");
    await page.getByLabel("API key").fill("not-the-right-key-at-all");
    await page.getByRole("button", { name: "Open" }).click();
    await page.getByText("The service does not take this key.").waitFor();
    await page.getByLabel("API key").fill(KEY);
    await page.getByRole("button", { name: "Open" }).click();
    const image = () => canvasState(page, '[aria-label="Live image"]');
    await until(image, ({ mean }) => mean > 5, "no frame came");
    await page.reload();
    await until(image, ({ mean }) => mean > 5, "the key was not kept");
    await page.context().close();
  });
});
