/** Train as a bench, while nobody works: the crop on the frame, data sets told before they are made, the list of jobs. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { BACKGROUND_TIMEOUT_MS, laidOut, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { makeSequence, REGION } from "./make_sequence.mjs";
import { tested } from "./tested.mjs";

const at = tested();

/** Parts of the page that are wider than what shows them. */
function tooWide(page) {
  return page.evaluate(() => [...document.querySelectorAll("*")]
    .filter((one) => ["auto", "scroll", "hidden"].includes(getComputedStyle(one).overflowX) || one === document.documentElement)
    .filter((one) => one.clientWidth > 1 && one.scrollWidth > one.clientWidth + 1 && getComputedStyle(one).textOverflow !== "ellipsis")
    .map((one) => one.className || one.localName));
}

const jobsOfService = async () => (await (await fetch(`${at.service.url}/v1/jobs`)).json()).jobs;

describe("a console without a sweep", () => {
  it("offers to upload one where it would be", async () => {
    const page = await openPage(at, "#/train");
    const [chooser] = await Promise.all([
      page.waitForEvent("filechooser"),
      page.getByRole("button", { name: "Upload one" }).click(),
    ]);
    assert.equal(chooser.isMultiple(), true);
    await picture(page, "train-empty");
    await page.getByRole("button", { name: "Simulate one over the built-in phantom" }).click();
    await page.getByText("The phantom is simulated").waitFor();
    await page.getByRole("link", { name: "Maps", exact: true }).click();
    await page.getByRole("link", { name: "Train", exact: true }).click();
    await page.getByText("211 to train from, 24 held out").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    await picture(page, "train-phantom");
    const { url } = at.service;
    assert.equal((await fetch(`${url}/v1/datasets/phantom`, { method: "DELETE" })).status, 204);
    await page.getByRole("navigation", { name: "Sections" }).getByRole("link", { name: /^Jobs/ }).click();
    await page.getByText("No jobs yet.").waitFor();
    assert.deepEqual(await seriousFindings(page), []);
  });
});

describe("the crop of a sequence", () => {
  it("is drawn on its frame, moved by keys, typed, and said to be outside, before anything is sent", async () => {
    const page = await openPage(at, "#/train");
    await page.getByLabel("Add a sweep").setInputFiles(makeSequence());
    const panel = page.getByTestId("crop");
    const surface = panel.locator("svg");
    await panel.getByText("96 × 72 of 96 × 72 pixels").waitFor();
    const box = await surface.boundingBox();
    const point = (column, row) => [box.x + (column / 96) * box.width, box.y + (row / 72) * box.height];
    await page.mouse.move(...point(20.5, 10.5));
    const edge = (name) => panel.getByRole("spinbutton", { name });
    // the region covers the image: a new one is drawn from its outside once it is smaller
    await edge("Left edge").fill("30");
    await edge("Left edge").press("Tab");
    await page.mouse.move(...point(20.5, 10.5));
    await page.mouse.down();
    await page.mouse.move(...point(79.5, 63.5), { steps: 4 });
    await page.mouse.up();
    await panel.getByText("60 × 54 of 96 × 72 pixels").waitFor();
    await panel.getByRole("application").press("ArrowLeft");
    await panel.getByRole("application").press("ArrowUp");
    await panel.getByRole("slider", { name: "Left edge" }).press("ArrowLeft");
    assert.deepEqual(await Promise.all(["Left edge", "Right edge", "Upper edge", "Lower edge"].map((name) => edge(name).inputValue())), ["18", "79", "9", "63"]);
    await picture(page, "train-crop");
    await edge("Right edge").fill("500");
    await edge("Right edge").press("Tab");
    await panel.getByText("The crop must lie within columns 0 to 96 and rows 0 to 72.").waitFor();
    await page.getByText("Choose frames, crop, correct times").click();
    const written = page.getByRole("textbox", { name: "Crop" });
    assert.equal(await written.inputValue(), "18:500,9:63");
    await written.fill(`${REGION.left}:${REGION.right},${REGION.top}:${REGION.bottom}`);
    await panel.getByText("64 × 56 of 96 × 72 pixels").waitFor();
    await panel.getByRole("slider", { name: "Frame", exact: true }).fill("9");
    assert.deepEqual(await seriousFindings(page), []);
    const delay = page.getByRole("textbox", { name: "Image delay, ms" });
    await delay.fill("fast");
    await page.getByRole("button", { name: "Upload and check" }).click();
    await page.getByText("image_delay_ms must be milliseconds, got 'fast'").waitFor();
    assert.match(page.faults.splice(0).join(), /^Failed to load resource: .* 422 .*image_delay_ms=fast\)$/);
    await delay.fill("");
    await page.getByRole("button", { name: "Upload and check" }).click();
    const dataset = page.getByTestId("dataset");
    await dataset.getByText("columns 16 to 80, rows 8 to 64 of 96 × 72").waitFor();
    await dataset.getByText("0.500 mm across, 0.500 mm in depth").waitFor();
    await dataset.getByText(/run along the probe's \+x, rows along its \+z/).waitFor();
    await picture(page, "train-region");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });
});

describe("a data set", () => {
  it("is told before it is rendered: its planes, some frames, how many, how large, how long", async () => {
    const page = await openPage(at, "#/train?show=render");
    const estimate = page.getByTestId("estimate");
    await estimate.getByText("1,000").waitFor();
    await estimate.getByText(/^up to \d/).waitFor();
    await estimate.getByText(/^about .* on one process/).waitFor();
    const thumbnails = page.getByRole("region", { name: "A few of them" }).locator("img");
    await until(() => thumbnails.count(), (count) => count === 6, "there are no examples");
    await page.getByText("256 of 1,000").waitFor();
    for (const label of ["Depth samples", "Scan lines"])
      assert.equal(await page.getByLabel(label, { exact: true }).getAttribute("placeholder"), "256");
    await page.getByLabel("Count").fill("400000");
    await page.getByLabel("Count").press("Tab");
    await estimate.getByText("400,000").waitFor();
    await estimate.getByText("in 80 files").waitFor();
    await page.getByRole("combobox", { name: "Poses" }).selectOption("fan");
    const { poses } = await (await fetch(`${at.service.url}/v1/scenes/demo/training-poses`)).json();
    await estimate.getByText((5 * poses.length).toLocaleString("en"), { exact: true }).waitFor(); // tilts of -10, -5, 0, 5, 10°
    const room = page.getByTestId("space").locator("canvas");
    await until(() => room.evaluate((canvas) => canvas.width), (width) => width > 200, "no planes in space");
    await page.getByRole("checkbox", { name: "Echo" }).check();
    await page.getByRole("combobox", { name: "Format" }).selectOption("tar");
    await until(() => thumbnails.count(), (count) => count === 6, "there are no examples");
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "train-render");
    await page.getByRole("button", { name: "Start rendering" }).click();
    await page.getByTestId("waits-for").waitFor();
    const [{ specification }] = await jobsOfService();
    assert.deepEqual(specification.sampler, { kind: "fan", tilt_deg: 10, step_deg: 5 });
    assert.deepEqual([specification.outputs, specification.format, specification.min_confidence], [["bmode", "echo"], "tar", 0.7]);
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("says why it cannot be", async () => {
    const page = await openPage(at, "#/train?show=render");
    await page.getByTestId("estimate").getByText("1,000").waitFor();
    await page.getByRole("combobox", { name: "Poses" }).selectOption("fan");
    await page.getByLabel("Step, °").fill("0.0001");
    await page.getByLabel("Step, °").press("Tab");
    await page.getByRole("alert").getByText(/100,000 poses that can be made/).waitFor();
  });
});

describe("what is written as name = value", () => {
  it("is asked for by the names that the service takes", async () => {
    const page = await openPage(at, "#/train?show=render");
    await page.getByText("More", { exact: true }).click();
    await page.getByLabel(/\bworker_labels\b.*: one name = value a line/).fill('worker_labels = {"site": "nowhere"}');
    await page.getByLabel("Count").fill("3");
    await page.getByRole("button", { name: "Start rendering" }).click();
    await page.getByText("nowhere").first().waitFor();
    const { jobs } = await (await fetch(`${at.service.url}/v1/jobs`)).json();
    assert.deepEqual(jobs[0].specification.worker_labels, { site: "nowhere" });
    await fetch(`${at.service.url}/v1/jobs/${jobs[0].id}:cancel`, { method: "POST" });
  });
});

describe("the list of jobs", () => {
  it("holds all kinds, is filtered, and its jobs are cancelled, repeated and deleted", async () => {
    const submit = (kind, specification) =>
      fetch(`${at.service.url}/v1/jobs`, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ kind, specification }) });
    await submit("evaluate", { dataset: "neck", scene: "demo" });
    await submit("render", { scene: "demo", sampler: { kind: "covered", count: 7, seed: 3 }, height: 32, format: "hdf5" });
    const page = await openPage(at, "#/train?show=jobs");
    const list = page.getByRole("region", { name: "Jobs" });
    const rows = list.getByRole("listitem");
    await until(() => rows.count(), (count) => count >= 3, "jobs are missing");
    await list.getByLabel("Kind of job").selectOption("evaluate");
    await until(() => rows.count(), (count) => count === 1, "it is not filtered");
    await list.getByLabel("State").selectOption("failed");
    await list.getByText("No matching jobs.").waitFor();
    await list.getByRole("button", { name: "Show all" }).click();
    await rows.filter({ hasText: "data set" }).first().getByRole("link").click();
    await page.getByRole("link", { name: "Repeat with changes" }).click();
    assert.equal(await page.getByRole("combobox", { name: "Poses" }).inputValue(), "covered");
    assert.deepEqual([await page.getByLabel("Count").inputValue(), await page.getByLabel("Seed").inputValue()], ["7", "3"]);
    assert.deepEqual([await page.getByLabel("Depth samples").inputValue(), await page.getByLabel("Format").inputValue()], ["32", "hdf5"]);
    await page.goBack();
    await page.getByTestId("job").waitFor();
    const before = (await jobsOfService()).length;
    await page.getByRole("button", { name: "Cancel" }).click();
    await page.getByTestId("job-state").getByText("cancelled").waitFor();
    await page.getByRole("button", { name: "Delete" }).click();
    await page.getByRole("group", { name: /Delete this job/ }).getByRole("button", { name: "Delete" }).click();
    await page.getByText("Choose a job to follow it").waitFor();
    assert.equal((await jobsOfService()).length, before - 1);
    assert.deepEqual(page.faults, []);
  });

  it("leaves a row alone of which nothing changed", async () => {
    const page = await openPage(at, "#/train?show=jobs");
    const row = page.getByRole("region", { name: "Jobs" }).getByRole("listitem").first();
    await row.waitFor();
    await page.waitForResponse(/\/v1\/datasets\?/);
    await page.waitForResponse(/\/v1\/jobs\?/);
    await laidOut(page);
    await page.evaluate(() => {
      globalThis.changes = 0;
      new MutationObserver((found) => (globalThis.changes += found.length)).observe(document.querySelector(".side"), { subtree: true, childList: true, characterData: true, attributes: true });
    });
    for (let polls = 0; polls < 2; polls++) await page.waitForResponse(/\/v1\/jobs\?/);
    await laidOut(page);
    assert.equal(await page.evaluate(() => globalThis.changes), 0, "each answer draws the list anew");
  });
});

describe("on a phone and enlarged", () => {
  for (const size of [{ width: 390, height: 844 }, { width: 640, height: 400 }])
    it(`nothing lies beside the screen at ${size.width} pixels`, async () => {
      const page = await openPage(at, "#/train", size);
      const current = page.getByRole("navigation", { name: "Sections" }).locator('[aria-current="page"]');
      for (const [hash, section] of [["#/train", "Sweep and training"], ["#/train?show=settings", "Sweep and training"], ["#/train?show=render", "Render a data set"], ["#/train?show=jobs", "Jobs"]]) {
        await page.evaluate((to) => (location.hash = to), hash);
        await current.getByText(section).waitFor();
        await until(() => page.locator(".skeleton").count(), (count) => count === 0, `${hash} is not whole`);
        await laidOut(page);
        assert.deepEqual(await tooWide(page), [], hash);
        await picture(page, `train-${size.width}-${hash.split("=")[1] ?? "sweep"}`);
      }
    });
});

describe("in German", () => {
  it("speaks German in every section", async () => {
    const page = await openPage(at, "#/train", { init: 'localStorage.setItem("ultragray.language", "de")' });
    await page.getByText("Sweep hinzufügen", { exact: true }).waitFor();
    await page.getByRole("link", { name: "Datensatz berechnen" }).click();
    await page.getByRole("button", { name: "Berechnung starten" }).waitFor();
    for (const label of ["Anzahl", "Drehung, °", "Schichtdicke, mm", "Kleinste Konfidenz", "Tiefenpunkte", "Abdeckung"])
      await page.getByLabel(label, { exact: true }).waitFor();
    await picture(page, "train-german");
  });
});
