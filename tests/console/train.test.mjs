/** Train: from a file on somebody's disk to a scene that is scanned, and what stands in the way. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { BACKGROUND_TIMEOUT_MS, canvasState, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { tested } from "./tested.mjs";

const HELD_OUT = "Held-out PSNR in dB over step: validation, linear between frames, median compounding";

const at = tested({
  environment: { ULTRAGRAY_EMBEDDED_WORKER: "true", ULTRAGRAY_TRAINING_THREADS: "1" },
  sweep: true,
});

async function upload(page, file, name) {
  await page.getByLabel("Add a sweep").setInputFiles(file);
  await page.getByLabel("Name", { exact: true }).fill(name);
  await page.getByRole("button", { name: "Upload and check" }).click();
}

async function start(page, scene, { confidence = "yes", ...settings }) {
  await page.getByRole("link", { name: /^All settings/ }).click();
  const table = page.getByTestId("settings");
  await table.getByLabel("Search the settings").fill("confidence");
  await table.getByLabel("Confidence", { exact: true }).selectOption({ label: confidence });
  const form = page.getByRole("region", { name: "Training", exact: true });
  await form.getByLabel("Scene", { exact: true }).fill(scene);
  for (const [label, value] of Object.entries(settings)) await form.getByLabel(label).fill(value);
  await page.getByRole("button", { name: "Start the training" }).click();
}

function state(page) {
  return page.getByTestId("job-state").textContent();
}

/** A training's picture may be asked for before its first checkpoint, or the moment that it ends: the page says so in words. */
const faultsOf = (page) => page.faults.filter((fault) => !/404.*\/preview\)$/.test(fault));

describe("train", () => {
  it("takes a sweep in, shows it, trains, tells how far it is, and opens the scene", async () => {
    const page = await openPage(at, "#/train");
    await upload(page, at.files.sweep, "sweep");
    await page.getByText("28 to train from, 5 held out").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    const frame = page.getByRole("img", { name: "Frame 0 of sweep" });
    await frame.waitFor();
    const room = page.getByTestId("space").locator("canvas");
    await until(() => room.evaluate((canvas) => canvas.width), (width) => width > 200, "no poses in space");
    await page.getByRole("button", { name: "Held out" }).click();
    await page.getByLabel("Frame", { exact: true }).fill("4");
    await page.getByRole("img", { name: "Frame 4 of sweep" }).waitFor();
    await page.getByRole("region", { name: "Contact sheet" }).getByRole("button", { name: "Frame 2" }).click();
    await page.getByRole("img", { name: "Frame 2 of sweep" }).waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "train-sweep");

    // What is left of the finishing is noted as it is shown: it may be over in less than a look from outside takes.
    await page.evaluate(() => {
      globalThis.finishing = [];
      const note = () => {
        if (!document.querySelector("[aria-current=step]")?.textContent.includes("Report")) return;
        globalThis.finishing.push(document.querySelector("[data-testid=time-left]")?.textContent ?? "");
      };
      new MutationObserver(note).observe(document.body, { subtree: true, childList: true, characterData: true, attributes: true });
    });
    await start(page, "made", { confidence: "no", Steps: "60", "Most Gaussians": "800" });
    await until(() => state(page), (text) => text !== "waits", "nobody began", BACKGROUND_TIMEOUT_MS);
    await page.getByRole("list", { name: "Phases of the training" }).getByText("Report and files").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    const told = () => page.evaluate(() => globalThis.finishing);
    const [first] = await until(told, ({ length }) => length > 0, "the finishing has no phase of its own", BACKGROUND_TIMEOUT_MS);
    assert.match(first, /left|almost done/, "its steps are done, and nobody says how long the rest takes");
    await until(() => state(page), (text) => text === "succeeded", "it did not succeed", BACKGROUND_TIMEOUT_MS);
    await page.getByText("Step 60 of 60", { exact: true }).waitFor();
    for (const [name, least] of [["Loss over step: training", 60], [HELD_OUT, 2]]) {
      const line = page.getByRole("img", { name }).locator("path.line");
      await until(() => line.getAttribute("d"), (d) => (d.match(/[ML]/g) ?? []).length >= least, `no curve: ${name}`);
    }
    assert.equal(await page.getByRole("img", { name: HELD_OUT }).locator("path.level").count(), 3); // with the neighbours in time
    const learned = page.getByRole("region", { name: "How it learned" });
    await learned.getByRole("img", { name: "The held-out frame" }).waitFor();
    await learned.getByRole("slider", { name: "Validation" }).press("Home");
    await learned.getByRole("img", { name: "Its rendering after step 3" }).waitFor();
    await learned.getByText(/after step 3, \d+\.\d\d dB/).waitFor();
    await page.getByRole("img", { name: /^Held-out frame/ }).first().waitFor();
    const [download] = await Promise.all([
      page.waitForEvent("download"),
      page.getByRole("link", { name: "made.ugr" }).click(),
    ]);
    assert.equal(download.suggestedFilename(), "made.ugr");
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "train-done");

    await page.getByRole("link", { name: "Open the scene" }).click();
    await until(() => canvasState(page, '[aria-label="Live image"]'), ({ mean }) => mean > 2, "the scene gives no frame");
    assert.match(page.url(), /#\/scan\/made(\?|$)/);
    assert.deepEqual([faultsOf(page), page.foreign], [[], []]);
  });

  it("repeats a training with changes, which are marked, and lays the earlier curve over the new one", async () => {
    const page = await openPage(at, "#/train?show=jobs");
    await page.getByRole("region", { name: "Jobs" }).getByRole("link", { name: /made/ }).click();
    await page.getByRole("link", { name: "Repeat with changes" }).click();
    const table = page.getByTestId("settings");
    const form = page.getByRole("region", { name: "Training", exact: true });
    await form.getByText("With the settings of made").waitFor();
    assert.equal(await form.getByLabel("Steps").inputValue(), "60");
    const row = (name) => table.getByRole("row", { name });
    await row(/max_gaussians/).getByText("changed").waitFor();
    await table.getByLabel("Search the settings").fill("learning rate scales");
    await table.getByLabel("Scales rate", { exact: true }).fill("2");
    await table.getByLabel("Scales rate", { exact: true }).press("Tab");
    await table.getByText("This must be at most 1.").waitFor();
    await table.getByLabel("Scales rate", { exact: true }).fill("0.02");
    await table.getByLabel("Scales rate", { exact: true }).press("Tab");
    await row(/scales_rate/).getByText("was 0.01").waitFor();
    await table.getByLabel("Search the settings").fill("");
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "train-settings");
    await form.getByLabel("Scene", { exact: true }).fill("again");
    await page.getByRole("button", { name: "Start the training" }).click();
    await until(() => state(page), (text) => text === "succeeded", "it did not succeed", BACKGROUND_TIMEOUT_MS);
    await page.getByText("Earlier runs of this sweep").click();
    await page.getByRole("checkbox", { name: /^made/ }).check();
    await page.getByRole("img", { name: "Loss over step: training, made" }).waitFor();
    await picture(page, "train-earlier");
    const jobs = (await (await fetch(`${at.service.url}/v1/jobs?kind=train`)).json()).jobs;
    assert.deepEqual(jobs[0].specification.settings, { steps: 60, max_gaussians: 800, confidence: false, scales_rate: 0.02 });
    assert.deepEqual([faultsOf(page), page.foreign], [[], []]);
  });

  it("shows the rendering as it is, keeps on after the service was down, and cancels", async () => {
    const page = await openPage(at, "#/train", { scheme: "dark" });
    await page.getByText("28 to train from, 5 held out").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    await start(page, "long", { Steps: "100000", "Most Gaussians": "800" });
    const preview = page.getByRole("img", { name: "A held-out frame and its rendering" });
    await preview.waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    await picture(page, "train-running");
    const steps = page.getByText(/^Step [\d,]+ of 100,000$/);
    const stepNow = async () => Number((await steps.textContent()).split(" ")[1].replaceAll(",", ""));
    await at.service.down();
    await page.getByText("The service does not answer. Trying again.").waitFor();
    const before = await stepNow();
    await at.service.up();
    await until(stepNow, (step) => step > before, "it did not go on", BACKGROUND_TIMEOUT_MS);
    await page.getByRole("button", { name: "Cancel" }).click();
    await until(() => state(page), (text) => text === "cancelled", "it was not cancelled", BACKGROUND_TIMEOUT_MS);
    await page.getByRole("button", { name: "Go on from the last checkpoint" }).waitFor();
  });

  it("says why an upload or a training is refused", async () => {
    const page = await openPage(at, "#/train");
    await upload(page, at.files.broken, "broken");
    const problem = page.getByTestId("upload-problem");
    await problem.getByText("frame 5").waitFor();
    await picture(page, "train-refused");
    await page.getByLabel("Add a sweep").setInputFiles({ name: "notes.zip", mimeType: "application/zip", buffer: Buffer.from("no archive") });
    await page.getByRole("button", { name: "Upload and check" }).click();
    await problem.getByText("neither .zip nor .tar").waitFor();
    await page.getByLabel("Scene", { exact: true }).last().fill("demo");
    await page.getByRole("button", { name: "Start the training" }).click();
    await page.getByRole("alert").getByText("there is already a scene 'demo'").waitFor();
    const names = (await (await fetch(`${at.service.url}/v1/datasets`)).json()).datasets.map(({ name }) => name);
    assert.deepEqual(names, ["sweep"]);
  });

  it("says what a job waits for that no worker can take, and cancels it", async () => {
    const specification = { scene: "demo", sampler: { kind: "training" }, worker_labels: { site: "lab1" } };
    const answer = await fetch(`${at.service.url}/v1/jobs`, {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ kind: "render", specification }),
    });
    const { id } = await answer.json();
    const page = await openPage(at, `#/train/${id}`);
    await page.getByTestId("waits-for").getByText("It waits for a worker with the label site=lab1; there is").waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "train-waits");
    await page.getByRole("button", { name: "Cancel" }).click();
    await until(() => state(page), (text) => text === "cancelled", "it was not cancelled", BACKGROUND_TIMEOUT_MS);
  });

  it("says that a job is gone", async () => {
    const page = await openPage(at, "#/train/0123456789abcdef01234567");
    await page.getByText("There is no such job").waitFor();
  });
});
