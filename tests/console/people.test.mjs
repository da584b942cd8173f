/** People with keys of every role: who one is, what one may do, whose things are, and the workers. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { describe, it } from "node:test";

import { BACKGROUND_TIMEOUT_MS, canvasState, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { askAs, giveKeys, pageOf } from "./people.mjs";
import { tested } from "./tested.mjs";

const at = tested({
  environment: { ULTRAGRAY_EMBEDDED_WORKER: "true", ULTRAGRAY_TRAINING_THREADS: "1", ULTRAGRAY_KEY_STREAMS: "1" },
  sweep: true,
  prepare: async (at) => {
    at.keys = await giveKeys(at.service);
    const body = readFileSync(at.files.sweep);
    await askAs(at, "alice", "PUT", "/v1/datasets/shared", { body, type: "application/zip" });
    const scene = { body: readFileSync(at.files.compared), type: "application/octet-stream" };
    await askAs(at, "alice", "PUT", "/v1/scenes/hers", scene);
  },
});

/** A training of the shared sweep that goes on until it is cancelled. */
function train(name, scene, isPrivate) {
  const specification = { dataset: "shared", scene, settings: { steps: 1_000_000, max_gaussians: 200 } };
  const body = JSON.stringify({ kind: "train", specification, private: isPrivate });
  return askAs(at, name, "POST", "/v1/jobs", { body });
}

describe("the key", () => {
  it("tells whose it is and what that person may, and makes room for another", async () => {
    const page = await openPage(at, "#/scan/demo");
    await page.getByLabel("API key").fill(at.keys.rita);
    await page.getByRole("button", { name: "Open" }).click();
    await page.getByRole("button", { name: "Your key: rita reader" }).click();
    const menu = page.getByRole("group", { name: "Your key" });
    await menu.getByText("You may look, render and stream.").waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "key-menu");
    await menu.getByRole("button", { name: "Use another key" }).click();
    await page.getByLabel("API key").fill(at.keys.admin);
    await page.getByRole("button", { name: "Open" }).click();
    await page.getByRole("button", { name: "Your key: admin admin" }).waitFor();
  });
});

describe("a reader", () => {
  it("scans, and is told who may do what is not there", async () => {
    const page = await pageOf(at, "rita", "#/scan/demo");
    await until(() => canvasState(page, '[aria-label="Live image"]'), ({ mean }) => mean > 5, "no frame came");
    await page.getByRole("link", { name: "Train", exact: true }).click();
    for (const what of ["add sweeps", "start trainings"]) {
      await page.getByText(`Only operators and admins may ${what}.`).waitFor();
    }
    assert.equal(await page.getByRole("button", { name: "Start the training" }).count(), 0);
    assert.equal(await page.getByLabel("Add a sweep").count(), 0);
    const remove = page.getByTestId("dataset").getByRole("button", { name: "Delete" });
    assert.equal(await remove.isDisabled(), true);
    assert.equal(await remove.getAttribute("title"), "Only operators and admins may delete it");
    await picture(page, "train-reader");
    await page.getByRole("link", { name: "Scenes and service" }).click();
    await page.getByText("Only operators and admins may import, load and unload scenes.").waitFor();
    await page.getByText("Only admins may pause, drain and resume workers.").waitFor();
    const row = page.getByTestId("scene-hers");
    await row.getByText("alice").waitFor();
    assert.equal(await row.getByRole("button", { name: "Load", exact: true }).count(), 0);
    assert.equal(await page.getByLabel("Import a scene").count(), 0);
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "scenes-reader");
    assert.deepEqual(page.faults, []);
  });
});

describe("a key that has as many streams as it may", () => {
  it("is told of it, and goes on when another one ends", async () => {
    const image = '[aria-label="Live image"]';
    const first = await pageOf(at, "rita", "#/scan/demo");
    await until(() => canvasState(first, image), ({ mean }) => mean > 5, "no frame came");
    const second = await pageOf(at, "rita", "#/scan/demo");
    await second.getByTestId("stream-barred").getByText("as many streams open as it may").waitFor();
    await first.close();
    await until(() => canvasState(second, image), ({ mean }) => mean > 5, "it does not go on");
    await second.getByTestId("stream-barred").waitFor({ state: "detached" });
  });
});

describe("an operator", () => {
  it("keeps a sweep, a job and a scene private", async () => {
    const page = await pageOf(at, "alice", "#/train");
    await page.getByLabel("Add a sweep").setInputFiles(at.files.sweep);
    await page.getByLabel("Name", { exact: true }).fill("mine");
    await page.getByRole("region", { name: "Sweep" }).getByRole("checkbox", { name: /^Private/ }).check();
    await picture(page, "train-private");
    await page.getByRole("button", { name: "Upload and check" }).click();
    const panel = page.getByRole("region", { name: "Dataset mine" });
    await panel.getByText("private").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });
    await panel.getByText("you", { exact: true }).waitFor();
    const choice = page.getByRole("region", { name: "Training" }).getByRole("checkbox", { name: /^Private/ });
    assert.equal(await choice.isChecked(), true, "a training of a private sweep is proposed as a public one");
    await page.getByLabel("Scene", { exact: true }).last().fill("secret");
    await page.getByLabel("Steps").fill("1000000");
    await page.getByRole("button", { name: "Start the training" }).click();
    const job = page.getByRole("region", { name: "Job train of secret" });
    await job.getByText("private").waitFor();
    await page.getByRole("region", { name: "Jobs" }).getByRole("link", { name: /secret/ }).getByText("private").waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "job-private");
    await job.getByRole("button", { name: "Cancel" }).click();
    await page.getByTestId("job-state").getByText("cancelled").waitFor();
    await page.getByRole("link", { name: "Scenes and service" }).click();
    await page.getByLabel("Import a scene").setInputFiles(at.files.compared);
    await page.getByLabel("Name", { exact: true }).fill("hidden");
    await page.getByRole("checkbox", { name: /^Private/ }).check();
    await page.getByRole("button", { name: "Import", exact: true }).click();
    await page.getByTestId("scene-hidden").getByText("private").waitFor({ timeout: BACKGROUND_TIMEOUT_MS });

    const other = await pageOf(at, "bob", "#/scenes");
    const row = other.getByTestId("scene-hers");
    const remove = row.getByRole("button", { name: "Delete" });
    await remove.waitFor();
    assert.equal(await remove.isDisabled(), true);
    assert.equal(await remove.getAttribute("title"), "Only alice and admins may delete it");
    assert.equal(await row.getByRole("button", { name: "Load", exact: true }).isEnabled(), true);
    assert.equal(await other.getByTestId("scene-hidden").count(), 0);
    await other.getByRole("link", { name: "Train", exact: true }).click();
    await other.getByTestId("dataset").getByText("alice").waitFor();
    assert.equal(await other.getByText("secret").count(), 0);
    assert.deepEqual([page.faults, other.faults], [[], []]);
  });

  it("starts another job of the list as a private one", async () => {
    const page = await pageOf(at, "alice", "#/train?show=jobs");
    await page.locator("summary", { hasText: /^Other jobs$/ }).click();
    const form = page.locator("details", { hasText: "Other jobs" });
    await form.getByRole("checkbox", { name: /^Private/ }).check();
    await form.getByRole("button", { name: "Start the job" }).click();
    await page.getByTestId("job").getByText("private").waitFor();
    await page.getByRole("button", { name: "Cancel" }).click(); // the worker is for the next test
  });

  it("leaves a job of somebody else alone", async () => {
    const { id } = await train("alice", "open", false);
    const page = await pageOf(at, "bob", `#/train/${id}`);
    const job = page.getByRole("region", { name: "Job train of open" });
    await job.getByText("Only alice and admins may cancel it.").waitFor();
    assert.equal(await job.getByRole("button", { name: "Cancel" }).count(), 0);
    await askAs(at, "alice", "POST", `/v1/jobs/${id}:cancel`);
    await job.getByText("Only alice and admins may try it again.").waitFor();
  });
});

describe("the workers", () => {
  it("are paused, drained and resumed by admins; what is private is busy to others", async () => {
    const { jobs } = await askAs(at, "admin", "GET", "/v1/jobs");
    for (const job of jobs.filter(({ state }) => ["queued", "running"].includes(state))) await askAs(at, "admin", "POST", `/v1/jobs/${job.id}:cancel`);
    const { id } = await train("alice", "quiet", true);
    const page = await pageOf(at, "admin", "#/scenes");
    const row = page.getByTestId(/^worker-/);
    const addresses = () => row.getByRole("link").evaluateAll((links) => links.map((link) => link.getAttribute("href")));
    await until(addresses, ([address]) => address === `#/train/${id}`, "the job at hand is not told");
    await row.getByText("working").waitFor();
    await row.getByText(/^cpu \d+(\.\d)? GB$/).waitFor(); // what it does jobs on
    const other = await pageOf(at, "bob", "#/scenes");
    const seen = other.getByTestId(/^worker-/);
    await seen.getByText("working").waitFor();
    await seen.getByText("a private one").waitFor();
    assert.equal(await seen.getByRole("button").count(), 0);
    assert.equal((await other.content()).includes(id.slice(0, 8)), false);

    await row.getByRole("button", { name: "Drain" }).click();
    await row.getByText("drained").waitFor();
    await seen.getByText("drained").waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "workers");
    await askAs(at, "alice", "POST", `/v1/jobs/${id}:cancel`);
    await row.getByRole("button", { name: "Resume" }).click();
    await row.getByText("idle").waitFor();
    await row.getByRole("button", { name: "Pause" }).click();
    await row.getByText("paused").waitFor();
    await row.getByRole("button", { name: "Resume" }).click();
    await row.getByText("idle").waitFor();
    assert.deepEqual([page.faults, other.faults], [[], []]);
  });
});

describe("the audit log", () => {
  it("is read by admins, by name and by operation, and by nobody else", async () => {
    await askAs(at, "alice", "POST", "/v1/scenes/demo:load");
    const page = await pageOf(at, "admin", "#/scenes");
    const log = page.getByTestId("audit");
    await log.getByLabel("What").fill("scene.load");
    await log.getByRole("cell", { name: "scene.load" }).first().waitFor();
    await log.getByLabel("Who").fill("alice");
    await log.getByRole("row", { name: /alice scene\.load demo OK/ }).first().waitFor();
    await log.getByLabel("Who").fill("nobody-of-that-name");
    await log.getByText("Nothing of that kind in this time.").waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "audit");
    const other = await pageOf(at, "bob", "#/scenes");
    await other.getByTestId("frames-rendered").waitFor();
    assert.equal(await other.getByTestId("audit").count(), 0);
    assert.deepEqual([page.faults, other.faults], [[], []]);
  });
});
