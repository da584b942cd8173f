/** Train, while nobody trains: uploads that go on, what stays as it is while lists are asked for, long curves. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { describe, it } from "node:test";

import { BACKGROUND_TIMEOUT_MS, hold, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { put } from "./sweep.mjs";
import { tested } from "./tested.mjs";

const at = tested({
  sweep: true,
  prepare: ({ service, files }) => put(service, "/v1/datasets/sweep", readFileSync(files.sweep), "application/zip"),
});

/** Closes the page as a person does; whether it asked first. */
async function asksBeforeClosing(page) {
  const asked = page.waitForEvent("dialog").then(async (dialog) => {
    assert.equal(dialog.type(), "beforeunload");
    await dialog.dismiss();
    return true;
  });
  const closed = page.waitForEvent("close").then(() => false);
  await page.close({ runBeforeUnload: true });
  for (const other of [asked, closed]) other.catch(() => undefined); // the one that does not come
  return Promise.race([asked, closed]);
}

describe("an upload", () => {
  it("goes on while other views are looked at, and leaving the page asks first", async () => {
    const page = await openPage(at, "#/train");
    const section = (name) => page.getByRole("navigation", { name: "Sections" }).getByRole("link", { name });
    const scene = page.getByRole("textbox", { name: "Scene" });
    assert.equal(await scene.inputValue(), "sweep");
    await page.getByRole("button", { name: "Start the training" }).click();
    await page.getByText(/^It waits for/).waitFor();
    await section("Sweep and training").click();
    await until(() => scene.inputValue(), (name) => name === "sweep-2", "a name that a training has is proposed");
    await page.getByTestId("dataset").waitFor();
    await page.getByLabel("Steps").fill("77");

    const release = await hold(page, /\/v1\/datasets\/slow\?/);
    await page.getByLabel("Add a sweep").setInputFiles(at.files.sweep);
    await page.getByLabel("Name", { exact: true }).fill("slow");
    await page.getByRole("button", { name: "Upload and check" }).click();
    const progress = page.getByLabel("Upload", { exact: true });
    await progress.waitFor();
    await section(/^Jobs/).click();
    await page.getByRole("region", { name: "Jobs" }).getByRole("link").click();
    await page.getByText(/^It waits for/).waitFor();
    await section("Sweep and training").click();
    await progress.waitFor();
    assert.equal(await page.getByLabel("Steps").inputValue(), "77");
    await page.getByRole("link", { name: "Scan", exact: true }).click();
    await page.getByLabel("Live image").waitFor();
    const sending = page.getByTestId("sending");
    await sending.getByLabel("Upload of slow", { exact: true }).waitFor();
    await picture(page, "upload-elsewhere");
    assert.deepEqual(await seriousFindings(page), []);
    assert.equal(await asksBeforeClosing(page), true);
    await page.getByRole("link", { name: "Train", exact: true }).click();
    await progress.waitFor();
    assert.equal(await page.getByLabel("Name", { exact: true }).inputValue(), "slow");
    release();
    await page.getByRole("region", { name: "Dataset slow" }).waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    assert.equal(await progress.count(), 0);
    assert.equal(await sending.count(), 0);
    assert.deepEqual([page.faults, page.foreign], [[], []]);
    assert.equal(await asksBeforeClosing(page), false);
  });

  it("is stopped from another view, and says there that it was refused", async () => {
    const page = await openPage(at, "#/train");
    const sending = page.getByTestId("sending");
    const begin = async (name, file) => {
      await page.getByRole("link", { name: "Train", exact: true }).click();
      if (file !== undefined) await page.getByLabel("Add a sweep").setInputFiles(file);
      await page.getByLabel("Name", { exact: true }).fill(name);
      await page.getByRole("button", { name: "Upload and check" }).click();
      await page.getByRole("link", { name: "Maps", exact: true }).click();
    };
    const release = await hold(page, /\/v1\/datasets\/away\?/);
    await begin("away", at.files.broken);
    await sending.getByRole("button", { name: "Stop the upload of away" }).click();
    await sending.waitFor({ state: "detached" });
    release();
    await begin("refused");
    await sending.getByText("not uploaded").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    await sending.getByRole("link", { name: "refused" }).click();
    await page.getByTestId("upload-problem").waitFor();
    assert.equal(await sending.count(), 0);
  });
});

describe("a dataset", () => {
  it("stays as it is looked at while the list is asked for again", async () => {
    const page = await openPage(at, "#/scenes");
    await page.addInitScript(() => {
      globalThis.buffersMade = 0;
      const { prototype } = WebGL2RenderingContext;
      const { createBuffer } = prototype;
      prototype.createBuffer = function () {
        globalThis.buffersMade += 1;
        return createBuffer.call(this);
      };
    });
    await page.goto(`${at.service.url}/#/train`);
    await page.reload();
    const room = page.getByTestId("space").locator("canvas");
    const shown = async () => (await room.screenshot()).toString("base64");
    let before = "";
    const still = (now) => now === before || ((before = now), false);
    await until(() => page.evaluate(() => globalThis.buffersMade), (made) => made > 0, "nothing is drawn");
    await until(shown, still, "it does not come to rest");
    const outside = before;
    const box = await room.boundingBox();
    await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
    await page.mouse.down();
    await page.mouse.move(box.x + box.width / 2 + 90, box.y + box.height / 2 + 20, { steps: 4 });
    await page.mouse.up();
    await until(shown, (now) => now !== outside && still(now), "it was not turned");
    const made = await page.evaluate(() => globalThis.buffersMade);
    for (let polls = 0; polls < 2; polls++) await page.waitForResponse(/\/v1\/datasets\?/);
    await page.evaluate(() => new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve))));
    assert.equal(await page.evaluate(() => globalThis.buffersMade), made, "it is built anew at each answer");
    assert.equal(await shown(), before, "it was looked at from elsewhere");
  });
});

describe("a job of any kind", () => {
  it("is specified by what the service says of the kind, and followed", async () => {
    const page = await openPage(at, "#/train?show=jobs");
    await page.getByText("Other jobs").click();
    await page.getByRole("combobox", { name: "Kind", exact: true }).selectOption("evaluate");
    await page.getByRole("combobox", { name: "Dataset" }).selectOption("sweep");
    await page.getByLabel("Baselines").check();
    assert.equal(await page.getByRole("combobox", { name: "Scene", exact: true }).last().inputValue(), "demo");
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "train-other-jobs");
    await page.getByRole("button", { name: "Start the job" }).click();
    await page.getByText(/^It waits for/).waitFor();
    const [job] = (await (await fetch(`${at.service.url}/v1/jobs?kind=evaluate`)).json()).jobs;
    const { dataset, scene, baselines } = job.specification;
    assert.deepEqual({ dataset, scene, baselines }, { dataset: "sweep", scene: "demo", baselines: true });
    assert.deepEqual(page.faults, []);
  });
});

describe("a volume of a scene", () => {
  it("is a job like others", async () => {
    const page = await openPage(at, "#/train?show=jobs");
    await page.getByText("Other jobs").click();
    await page.getByRole("combobox", { name: "Kind", exact: true }).selectOption("voxelize");
    await page.getByRole("combobox", { name: "Field" }).selectOption("labels");
    await page.getByLabel("Spacing, mm").fill("2");
    await page.getByLabel("Box, mm").fill("-10:10,-2:2,10:30");
    await page.getByRole("combobox", { name: "Format" }).selectOption("nrrd");
    await page.getByRole("button", { name: "Start the job" }).click();
    await page.getByText(/^It waits for/).waitFor();
    const [job] = (await (await fetch(`${at.service.url}/v1/jobs?kind=voxelize`)).json()).jobs;
    const { scene, field, spacing_mm, box_mm, format } = job.specification;
    assert.deepEqual(
      { scene, field, spacing_mm, box_mm, format },
      { scene: "demo", field: "labels", spacing_mm: 2, box_mm: "-10:10,-2:2,10:30", format: "nrrd" },
    );
    assert.deepEqual(page.faults, []);
  });
});

describe("a scene that moves", () => {
  it("is made by a field of displacements of a file", async () => {
    const page = await openPage(at, "#/train?show=jobs");
    await page.getByText("Other jobs").click();
    await page.getByRole("combobox", { name: "Kind", exact: true }).selectOption("motion");
    await page.getByLabel("Into").fill("inhaled");
    const head = [
      "NRRD0004", "type: float", "dimension: 4", "sizes: 3 2 2 2", "space: right-anterior-superior", "encoding: raw", "endian: little",
      "space directions: none (200,0,0) (0,200,0) (0,0,200)", "space origin: (-100,-100,-100)", "", "",
    ].join("\n");
    const buffer = Buffer.concat([Buffer.from(head), Buffer.alloc(96)]);
    await page.getByLabel("Field", { exact: true }).setInputFiles({ name: "inhale.nrrd", mimeType: "application/octet-stream", buffer });
    await page.getByRole("combobox", { name: "Field leads" }).selectOption("to-rest");
    await picture(page, "train-motion");
    await page.getByRole("button", { name: "Start the job" }).click();
    await page.getByText(/^It waits for/).waitFor();
    const [job] = (await (await fetch(`${at.service.url}/v1/jobs?kind=motion`)).json()).jobs;
    const { scene, into, field, field_leads } = job.specification;
    assert.deepEqual({ scene, into, format: field.format, field_leads }, { scene: "demo", into: "inhaled", format: "nrrd", field_leads: "to-rest" });
    assert.deepEqual(page.faults, []);
  });
});

describe("a long training", () => {
  it("asks for a thinner curve once, and goes on where that fails", async () => {
    const page = await openPage(at, "#/scenes");
    const steps = 1700;
    const job = (step, state) => ({
      id: "long", kind: "train", state, specification: { dataset: "sweep", scene: "long" },
      created_at: "2026-01-01T00:00:00Z", started_at: null, finished_at: null, reason: null, error: null, retry_of: null,
      progress: { phase: "training", step, steps, loss: 1 / step, val_psnr_db: null, gaussians: 1, rate_per_s: 1, seconds_left: 119.7 },
      artifacts: [], metrics: {},
    });
    const told = Array.from({ length: steps }, (_, i) => `event: progress\ndata: ${JSON.stringify(job(i + 1, "running"))}\n\n`);
    let asked = 0;
    await page.route(/\/jobs\/long\/events$/, (route) => route.fulfill({ contentType: "text/event-stream", body: told.join("") }));
    await page.route(/\/jobs\/long\/curve$/, (route) => (++asked === 1 ? route.fulfill({ json: { points: [], baselines: {} } }) : route.abort()));
    const broken = page.waitForEvent("requestfailed");
    await page.evaluate(() => (location.hash = "#/train/long"));
    await broken;
    await page.getByText("Step 1,700 of 1,700", { exact: true }).waitFor();
    assert.ok(asked <= 3, `${asked} times`); // the first, the thinner one, that of the next connection
    await page.getByText("The service does not answer. Trying again.").waitFor();
    assert.deepEqual(page.faults.filter((fault) => !fault.startsWith("Failed to load resource")), []);
  });
});
