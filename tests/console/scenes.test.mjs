/** Scenes and service: what there is, what is held in memory, files in and out, and how the service fares. */

import assert from "node:assert/strict";
import { readFileSync, writeFileSync } from "node:fs";
import path from "node:path";
import { describe, it } from "node:test";

import { BACKGROUND_TIMEOUT_MS, focused, hold, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { put } from "./sweep.mjs";
import { tested } from "./tested.mjs";

const at = tested({
  sweep: true,
  prepare: async ({ service }) => writeFileSync(path.join(service.data, "damaged.ugr"), "no scene"),
});

describe("scenes and service", () => {
  it("imports, loads, unloads, gives back and deletes a scene", async () => {
    const page = await openPage(at, "#/scenes");
    await page.getByLabel("Import a scene").setInputFiles(at.files.compared);
    await page.getByLabel("Name", { exact: true }).fill("mine");
    await page.getByRole("button", { name: "Import", exact: true }).click();
    await page.getByRole("status").getByText("mine is there.").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    const row = page.getByTestId("scene-mine");
    await row.getByRole("button", { name: "Load", exact: true }).click();
    await row.getByText("loaded").waitFor();
    await picture(page, "scenes");
    await row.getByRole("button", { name: "Unload" }).click();
    await row.getByRole("button", { name: "Load", exact: true }).waitFor();
    const [download] = await Promise.all([page.waitForEvent("download"), row.getByRole("link", { name: "Download" }).click()]);
    assert.equal(download.suggestedFilename(), "mine.ugr");
    assert.deepEqual(readFileSync(await download.path()), readFileSync(at.files.compared));
    await row.getByRole("link", { name: "mine", exact: true }).click();
    await page.getByRole("link", { name: "Scenes and service" }).click();
    for (const answer of ["Enter", "Escape"]) {
      await row.getByRole("button", { name: "Delete" }).press("Enter");
      await page.keyboard.press(answer); // Keep has the focus
      await until(() => focused(page), (text) => text === "Delete", "the focus is lost");
    }
    await row.getByRole("button", { name: "Delete" }).click();
    await row.getByRole("group", { name: "Delete mine?" }).getByRole("button", { name: "Delete" }).click();
    await row.waitFor({ state: "detached" });
    await until(() => focused(page), (text) => text === "List of scenes", "the focus is lost");
    assert.equal(await page.getByRole("banner").getByLabel("Scene").inputValue(), "demo");
    assert.equal(await page.getByRole("link", { name: "Compare", exact: true }).getAttribute("href"), "#/compare/demo");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("shows of each scene a frame, its probe, its figures and its date, and leads to Compare", async () => {
    const page = await openPage(at, "#/scenes");
    const row = page.getByTestId("scene-demo");
    const seen = row.locator("img");
    await seen.waitFor();
    assert.ok(await seen.evaluate((image) => image.decode().then(() => image.naturalWidth >= 96)), "no frame");
    for (const text of ["Linear", "256 × 256", "50,000 Gaussians", "23.9 dB", "0.934", String(new Date().getFullYear())])
      await row.getByText(text).first().waitFor();
    await put(at.service, "/v1/scenes/resting", readFileSync(at.files.compared), "application/octet-stream");
    const resting = page.getByTestId("scene-resting");
    await resting.locator("img").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    const { scenes } = await (await fetch(`${at.service.url}/v1/scenes`)).json();
    assert.equal(scenes.find(({ name }) => name === "resting").loaded, false, "it was loaded for its picture");
    const address = `${at.service.url}/v1/scenes/resting/thumbnail.png`;
    const { headers } = await fetch(address);
    assert.equal((await fetch(address, { headers: { "If-None-Match": headers.get("etag") } })).status, 304);
    await row.getByRole("link", { name: "Compare demo" }).click();
    await until(() => page.url(), (url) => url.endsWith("#/compare/demo"), "it leads elsewhere");
  });

  it("begins anew with a scene that takes the place of a deleted one", async () => {
    const scene = readFileSync(at.files.compared);
    await put(at.service, "/v1/scenes/again", scene, "application/octet-stream");
    const page = await openPage(at, "#/scan/again");
    const gain = page.getByRole("slider", { name: "Gain", exact: true });
    await gain.fill("6");
    await page.getByRole("link", { name: "Scenes and service" }).click();
    const row = page.getByTestId("scene-again");
    await row.getByRole("button", { name: "Delete" }).click();
    await row.getByRole("group", { name: "Delete again?" }).getByRole("button", { name: "Delete" }).click();
    await row.waitFor({ state: "detached" });
    await put(at.service, "/v1/scenes/again", scene, "application/octet-stream");
    await row.getByRole("link", { name: "again", exact: true }).click();
    assert.equal(await gain.inputValue(), "0");
  });

  it("goes on with an import while other views are looked at", async () => {
    const page = await openPage(at, "#/scenes");
    const release = await hold(page, /\/v1\/scenes\/late$/);
    await page.getByLabel("Import a scene").setInputFiles(at.files.compared);
    await page.getByLabel("Name", { exact: true }).fill("late");
    await page.getByRole("button", { name: "Import", exact: true }).click();
    await page.getByLabel("Import", { exact: true }).waitFor();
    await page.getByRole("link", { name: "Train", exact: true }).click();
    await page.getByRole("link", { name: "Scenes and service" }).click();
    await page.getByLabel("Import", { exact: true }).waitFor();
    release();
    await page.getByRole("status").getByText("late is there.").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
  });

  it("says what cannot be imported or read, and offers no deletion of what is not the service's", async () => {
    const page = await openPage(at, "#/scenes");
    await page.getByTestId("scene-damaged").getByText("not a scene file").waitFor();
    await page.getByLabel("Import a scene").setInputFiles({ name: "a b.ugr", mimeType: "", buffer: Buffer.from("nothing") });
    assert.equal(await page.getByLabel("Name", { exact: true }).inputValue(), "a-b");
    await page.getByRole("button", { name: "Import", exact: true }).click();
    await page.getByTestId("import-problem").getByText("not a scene file").waitFor();
    await put(at.service, "/v1/scenes/removable", readFileSync(at.files.compared), "application/octet-stream");
    await page.getByTestId("scene-removable").getByRole("button", { name: "Delete" }).waitFor();
    for (const name of ["demo", "damaged"])
      assert.equal(await page.getByTestId(`scene-${name}`).getByRole("button", { name: "Delete" }).count(), 0);
  });

  it("shows frames, times and errors of the last minutes", async () => {
    const page = await openPage(at, "#/scenes");
    const frames = page.getByTestId("frames-rendered");
    await page.locator("[data-testid=scene-demo] img").waitFor(); // a frame, too
    await page.waitForTimeout(2500); // until it is counted
    const before = Number(await frames.textContent());
    const matrix = [[1, 0, 0, 0], [0, 1, 0, 5], [0, 0, 1, 0], [0, 0, 0, 1]];
    const headers = { "Content-Type": "application/json" };
    for (let i = 0; i < 12; i++)
      await fetch(`${at.service.url}/v1/scenes/demo/render`, { method: "POST", headers, body: JSON.stringify({ pose: { matrix } }) });
    await fetch(`${at.service.url}/v1/scenes/demo/render`, {
      method: "POST",
      headers,
      body: JSON.stringify({ pose: { matrix }, height: 512, width: 512, timeout_ms: 0.001 }),
    });
    await until(() => frames.textContent(), (text) => Number(text) === before + 12, "not all frames were counted");
    const latency = page.getByRole("img", { name: /^Latency, median in ms/ });
    await until(() => latency.locator("path.line").nth(1).getAttribute("d"), (d) => d !== "", "no render times");
    await page.getByRole("button", { name: "99th percentile" }).click();
    await page.getByRole("img", { name: /^Latency, 99th percentile/ }).waitFor();
    await page.getByRole("img", { name: /^Errors over/ }).waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "service");
  });

  it("says that the service is down, and goes on when it is back", async () => {
    const page = await openPage(at, "#/scenes", { width: 820, height: 1180 });
    await page.getByTestId("frames-rendered").waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await at.service.down();
    await page.getByText("The list may be out of date.").waitFor();
    await page.getByText("The service does not answer. Trying again.").waitFor();
    await picture(page, "scenes-down");
    await at.service.up();
    await page.getByText("The list may be out of date.").waitFor({ state: "detached" });
    await page.getByText("The service does not answer. Trying again.").waitFor({ state: "detached" });
  });
});
