/** A service that asks for a key: the page asks the person, once a tab. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import path from "node:path";
import { describe, it } from "node:test";

import { BACKGROUND_TIMEOUT_MS, canvasState, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { tested } from "./tested.mjs";

const KEY = "a-key-of-the-tests";

const at = tested({ environment: { ULTRAGRAY_API_KEYS: KEY }, sweep: true });

describe("a key", () => {
  it("opens the page, the stream included, and is kept over a reload", async () => {
    const page = await openPage(at, "#/scan/demo");
    await page.getByText("This service asks for a key").waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "key");
    await page.getByLabel("API key").fill("a–key–with–dashes–of–a–word–processor");
    await page.getByRole("button", { name: "Open" }).click();
    await page.getByRole("alert").getByText("plain letters, digits and signs").waitFor();
    await page.getByLabel("API key").fill("not-the-right-key-at-all");
    await page.getByRole("button", { name: "Open" }).click();
    await page.getByText("The service does not take this key.").waitFor();
    await page.getByLabel("API key").fill(KEY);
    await page.getByRole("button", { name: "Open" }).click();
    const image = () => canvasState(page, '[aria-label="Live image"]');
    await until(image, ({ mean }) => mean > 5, "no frame came");
    await page.reload();
    await until(image, ({ mean }) => mean > 5, "the key was not kept");
  });

  it("goes with uploads, pictures and downloads", async () => {
    const page = await openPage(at, "#/train");
    await page.getByLabel("API key").fill(KEY);
    await page.getByRole("button", { name: "Open" }).click();
    await page.getByLabel("Add a sweep").setInputFiles(at.files.sweep);
    await page.getByRole("button", { name: "Upload and check" }).click();
    await page.getByText("28 to train from, 5 held out").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    await page.getByRole("img", { name: "Frame 0 of sweep" }).waitFor();
    await page.getByRole("link", { name: "Scenes and service" }).click();
    const [download] = await Promise.all([
      page.waitForEvent("download"),
      page.getByTestId("scene-demo").getByRole("button", { name: "Download" }).click(),
    ]);
    assert.equal(download.suggestedFilename(), "demo.ugr");
    assert.deepEqual(readFileSync(await download.path()), readFileSync(path.join(at.service.data, "demo.ugr")));
  });
});
