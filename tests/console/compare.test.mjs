/** Compare: held-out frames beside what the scene and the classical way make of them. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { describe, it } from "node:test";

import { BACKGROUND_TIMEOUT_MS, hold, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { cut } from "./reach.mjs";
import { poseOf } from "./scan_page.mjs";
import { put } from "./sweep.mjs";
import { tested } from "./tested.mjs";

const HELD_OUT = 5;
const DEMO_MS = 900_000; // its sweep is simulated, in a process that comes last on a busy machine

const at = tested({
  sweep: true,
  prepare: async ({ service, files }) => {
    await put(service, "/v1/datasets/sweep", readFileSync(files.sweep), "application/zip");
    await put(service, "/v1/scenes/compared", readFileSync(files.compared), "application/octet-stream");
  },
});

/** Grey values of a picture as the page shows it. */
function shown(page, name) {
  return page.getByRole("region", { name, exact: true }).locator("canvas").first().evaluate((canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return [...data].filter((_, i) => i % 4 === 0);
  });
}

/** Waits until the picture is the one that was asked for. */
function arrived(page, name) {
  return page.getByRole("region", { name, exact: true }).locator('[role="img"][aria-busy="false"]').waitFor();
}

/** Waits until every frame is measured, and gives what the service says of them. */
async function measured(page, scene, timeout = BACKGROUND_TIMEOUT_MS) {
  await page.getByTestId("comparison").waitFor({ timeout });
  await page.getByTestId("working").waitFor({ state: "detached", timeout });
  return (await fetch(`${at.service.url}/v1/scenes/${scene}/comparison`)).json();
}

const against = (page, label) => page.getByLabel("Compare the truth with").selectOption({ label });

const rms = (a, b) => Math.sqrt(a.reduce((sum, value, i) => sum + (value - b[i]) ** 2, 0) / a.length);

describe("compare", () => {
  it("computes the comparison, then steps through the frames with their metrics", async () => {
    const page = await openPage(at, "#/compare/compared");
    const { frames } = await measured(page, "compared");
    assert.equal(frames.length, HELD_OUT);
    const row = page.getByRole("row", { name: /^PSNR/ });
    await until(() => row.textContent(), (text) => text.includes(frames[0].psnr_db.toFixed(2)), "not its PSNR");
    assert.ok((await row.textContent()).includes(frames[0].median_psnr_db.toFixed(2)));

    await arrived(page, "Truth");
    await arrived(page, "Rendering");
    const [truth, rendering] = [await shown(page, "Truth"), await shown(page, "Rendering")];
    await against(page, "Median compounding");
    await arrived(page, "Median compounding");
    const median = await shown(page, "Median compounding");
    assert.ok(rms(truth, rendering) < rms(truth, median), "the scene that made the frames is not nearer to them");

    await page.keyboard.press("ArrowRight");
    await until(() => page.getByTestId("frame-number").textContent(), (text) => text === `Frame ${frames[1].frame_number}`, "no step");
    await until(() => row.textContent(), (text) => text.includes(frames[1].psnr_db.toFixed(2)), "the metrics stood still");
    await until(() => shown(page, "Truth"), (now) => rms(now, truth) > 1, "the picture stood still");
    await page.getByRole("slider", { name: "Frame", exact: true }).fill(String(HELD_OUT));
    await until(() => page.getByTestId("frame-number").textContent(), (text) => text === `Frame ${frames.at(-1).frame_number}`, "no jump");
    assert.equal(await page.getByRole("button", { name: "Next frame" }).isDisabled(), true);

    await page.getByRole("button", { name: "GMSD" }).click();
    const chart = page.getByRole("img", { name: /^GMSD over/ });
    const box = await chart.boundingBox();
    await page.mouse.click(box.x + 50, box.y + 60); // at its left end
    await until(() => page.getByTestId("frame-number").textContent(), (text) => text === `Frame ${frames[0].frame_number}`, "no pick");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
    await picture(page, "compare");
  });

  it("shows the first frame while the others are measured, and says which one it is at", async () => {
    const page = await openPage(at, "#/scenes");
    const { frames, ...whole } = await (await fetch(`${at.service.url}/v1/scenes/compared/comparison`)).json();
    const unknown = ([name]) => !/_db|ssim|gms|distance/.test(name);
    let known = 1; // frames that are rendered; of the first one the nearest frame, too
    const soFar = frames.map((frame) => Object.fromEntries(Object.entries(frame).map((one) => (unknown(one) ? one : [one[0], null]))));
    const answer = () => frames.map((frame, i) => ({
      ...soFar[i],
      ...(i < known && Object.fromEntries(Object.entries(frame).filter(([name]) => !/^(nearest|linear|median)_/.test(name)))),
    }));
    await page.route(/compared\/comparison$/, (route) => route.fulfill({ json: { ...whole, state: "running", progress: 0.1, frames: answer() } }));
    let asked = 0;
    page.on("request", (request) => (asked += /\/comparison\/0\/truth\.png$/.test(request.url())));
    await page.goto(`${at.service.url}/#/compare/compared`);
    await arrived(page, "Rendering");
    await page.getByTestId("working").getByText(`Rendering: frame 2 of ${HELD_OUT}`).waitFor();
    const row = page.getByRole("row", { name: /^PSNR/ });
    assert.equal((await row.textContent()).match(/–/g).length, 6, "figures that nobody measured");
    await page.getByRole("button", { name: "All methods" }).click();
    assert.equal(await page.getByRole("region", { name: "Nearest frame" }).locator("canvas").count(), 0, "a picture that nobody drew");
    assert.equal(await page.getByRole("button", { name: "Worst", exact: true }).isDisabled(), true);
    await picture(page, "compare-under-way");
    known = 3;
    await page.getByTestId("working").getByText(`Rendering: frame 4 of ${HELD_OUT}`).waitFor();
    assert.equal(asked, 1, "the same picture was fetched at each answer");
    await page.unroute(/compared\/comparison$/);
    await measured(page, "compared");
    await arrived(page, "Median compounding");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
    await picture(page, "compare-all");
  });

  it("tells a picture that is late or did not come, and gets it", async () => {
    const page = await openPage(at, "#/compare/compared");
    const truth = page.getByRole("region", { name: "Truth", exact: true });
    await arrived(page, "Truth");
    const release = await hold(page, /comparison\/1\/truth\.png$/);
    await page.getByRole("button", { name: "Next frame" }).click();
    await until(() => truth.locator('[aria-busy="true"] canvas').first().evaluate((canvas) => Number(getComputedStyle(canvas).opacity)), (opacity) => opacity < 0.5, "the picture before looks like the new one");
    release();
    await until(() => truth.locator('[aria-busy="false"] canvas').first().evaluate((canvas) => getComputedStyle(canvas).opacity), (opacity) => opacity === "1", "it is not shown");

    let down = true;
    await page.route(/comparison\/2\/truth\.png$/, (route) => (down ? route.abort() : route.continue()));
    await page.getByRole("button", { name: "Next frame" }).click();
    await truth.getByText("The service does not answer.").waitFor();
    down = false;
    await arrived(page, "Truth");
  });

  it("can be asked again after it failed", async () => {
    const page = await openPage(at, "#/scenes");
    let failing = true;
    const failed = { state: "failed", progress: 0, dataset: "sweep", frames: [], reason: "there was not enough memory" };
    await page.route(/\/comparison$/, (route) => (failing ? route.fulfill({ json: failed }) : route.continue()));
    await page.goto(`${at.service.url}/#/compare/compared`);
    await page.getByRole("alert").getByText("there was not enough memory").waitFor();
    const failedAgain = page.waitForResponse(/\/comparison$/);
    await page.getByRole("button", { name: "Try again" }).click();
    await failedAgain;
    await page.getByRole("alert").getByText("there was not enough memory").waitFor();
    failing = false;
    await page.getByRole("button", { name: "Try again" }).click();
    await page.getByTestId("comparison").waitFor();
  });

  it("is usable by readers of the screen and on a tablet", async () => {
    for (const [width, height, scheme] of [[1280, 800, "dark"], [820, 1180, "light"]]) {
      const page = await openPage(at, "#/compare/compared", { width, height, scheme });
      await arrived(page, "Truth");
      assert.deepEqual(await seriousFindings(page), []);
      await picture(page, `compare-${width}`);
      await page.context().close();
    }
  });

  it("compares the demo scene out of the box, with frames that are simulated", async () => {
    const page = await openPage(at, "#/compare/demo");
    const { frames, dataset } = await measured(page, "demo", DEMO_MS);
    const { metrics } = await (await fetch(`${at.service.url}/v1/scenes/demo`)).json();
    const mean = frames.reduce((sum, frame) => sum + frame.psnr_db, 0) / frames.length;
    assert.ok(Math.abs(mean - metrics.psnr_db) < 0.3, `${mean} dB, where the scene was measured at ${metrics.psnr_db}`);
    assert.equal(dataset, "phantom");
    await arrived(page, "Similarity");
    assert.equal(await page.locator("figure circle").count(), frames.length, "not a dot a frame");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
    await picture(page, "compare-demo");
  });

  it("enlarges, moves and points at the same place of all pictures", async () => {
    const page = await openPage(at, "#/compare/compared");
    await arrived(page, "Difference");
    const places = () =>
      page.locator(".picture canvas").evaluateAll((all) => all.map((canvas) => getComputedStyle(canvas).transform));
    const before = await places();
    const box = await page.getByRole("region", { name: "Truth", exact: true }).locator(".picture").boundingBox();
    await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
    await page.mouse.wheel(0, -100);
    const enlarged = await until(places, (now) => now.every((one, i) => one !== before[i]), "not all were enlarged");
    assert.equal(new Set(enlarged).size, 1, "they show different places");
    await page.getByTestId("values").getByText(/truth \d+, other \d+ of 255/).waitFor();
    assert.equal(await page.locator("svg.cursor").count(), 4);
    await page.keyboard.press("0");
    await until(places, (now) => now.every((one, i) => one === before[i]), "not back at all of the picture");
  });

  it("wipes and flickers between two pictures", async () => {
    const page = await openPage(at, "#/compare/compared");
    await arrived(page, "Truth");
    const truth = await shown(page, "Truth");
    await page.getByRole("button", { name: "Wipe" }).click();
    const wiped = page.getByRole("region", { name: "Truth | Rendering" });
    await page.getByLabel("Where the truth ends").fill("0.25");
    await until(() => wiped.locator("canvas").nth(1).evaluate((canvas) => canvas.style.clipPath), (path) => path.includes("75%"), "the wipe stood still");
    await page.getByRole("button", { name: "Flicker" }).click();
    await page.getByRole("region", { name: "Shown: Truth" }).waitFor();
    await page.getByRole("region", { name: "Shown: Rendering" }).waitFor();
    await page.getByRole("region", { name: "Shown: Truth" }).waitFor();
    await page.keyboard.press("x");
    const held = await page.getByRole("region", { name: /^Shown/ }).getAttribute("aria-label");
    await page.waitForTimeout(1500);
    assert.equal(await page.getByRole("region", { name: /^Shown/ }).getAttribute("aria-label"), held);
    if (held.endsWith("Truth")) assert.ok(rms(await shown(page, held), truth) < 1);
  });

  it("goes from the worst frame to the best, keeps it in the address, and leads to its pose", async () => {
    const page = await openPage(at, "#/compare/compared?with=nearest&metric=gmsd&order=worst");
    await page.getByTestId("comparison").waitFor();
    const { frames } = await (await fetch(`${at.service.url}/v1/scenes/compared/comparison`)).json();
    const worst = [...frames].sort((a, b) => b.nearest_gmsd - a.nearest_gmsd);
    await page.getByRole("button", { name: "Worst", exact: true }).click();
    const number = () => page.getByTestId("frame-number").textContent();
    await until(number, (text) => text === `Frame ${worst[0].frame_number}`, "not the worst");
    await page.keyboard.press("ArrowRight");
    await until(number, (text) => text === `Frame ${worst[1].frame_number}`, "not the second worst");
    await until(() => page.evaluate(() => location.hash), (hash) => worst[1].index === 0 || hash.includes(`frame=${worst[1].index}`), "not in the address");
    await page.reload();
    await until(number, (text) => text === `Frame ${worst[1].frame_number}`, "a reload lost the frame");

    const download = page.waitForEvent("download");
    await page.getByRole("button", { name: "Save as CSV" }).click();
    const [head, ...lines] = readFileSync(await (await download).path(), "utf8").trim().split("\n");
    assert.equal(lines.length, HELD_OUT);
    const values = Object.fromEntries(head.split(",").map((name, i) => [name, lines[0].split(",")[i]]));
    assert.equal(Number(values.median_gms), frames[0].median_gms);

    await page.getByRole("link", { name: "Open this pose in Scan" }).click();
    const wanted = worst[1].pose.flat();
    const isThere = ({ position_mm: { x, y, z } }) => [x, y, z].every((value, i) => Math.abs(value - wanted[4 * i + 3]) < 1e-3);
    await until(() => poseOf(page).catch(() => null), (pose) => pose !== null && isThere(pose), `Scan is not at ${wanted}`);
  });

  it("leads to the comparison with other methods, on the same frames", async () => {
    const page = await openPage(at, "#/compare/compared");
    await page.getByTestId("comparison").waitFor();
    await page.getByRole("link", { name: "Other methods" }).click();
    const form = page.locator("details", { hasText: "Other jobs" });
    await until(() => form.getByLabel("Kind").inputValue(), (kind) => kind === "compare", "another kind of job is begun");
    await until(() => form.getByLabel("Dataset").inputValue(), (name) => name === "sweep", "another sweep is chosen");
    await form.getByLabel("Methods").waitFor();
    await picture(page, "compare-methods");
    assert.deepEqual(page.faults, []);
  });

  it("keeps its pictures in sight at 200 % zoom, on a tablet and on a phone", async () => {
    for (const [width, height] of [[640, 400], [1024, 768], [768, 1024], [390, 844]]) {
      const page = await openPage(at, "#/compare/compared", { width, height, touch: width > 640 });
      await arrived(page, "Truth");
      for (const name of ["Truth", "Rendering", "Difference", "Similarity"]) {
        const { width: across, height: down } = await page.getByRole("region", { name, exact: true }).locator(".picture").boundingBox();
        assert.ok(across >= 150 && down >= 150, `${name} has ${across} x ${down} pixels at ${width} x ${height}`);
      }
      assert.deepEqual(await cut(page), [], `at ${width} pixels`);
      await picture(page, `compare-${width}`);
      await page.context().close();
    }
  });

  it("says what to do where the service has not the scene's dataset", async () => {
    await fetch(`${at.service.url}/v1/datasets/sweep`, { method: "DELETE" });
    const page = await openPage(at, "#/compare/compared");
    await page.getByRole("region", { name: "The sweep of this scene is not here" }).waitFor();
    assert.equal(await page.getByRole("alert").count(), 0);
    await picture(page, "compare-without-dataset");
    await page.getByRole("link", { name: "Upload the sweep" }).click();
    await until(() => page.evaluate(() => location.hash), (hash) => hash.startsWith("#/train"), "it leads nowhere");
  });
});
