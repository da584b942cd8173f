/** Where a real frame was taken: chosen as a file, looked for about the present pose, shown beside the scene there, gone to. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { picture, seriousFindings, until } from "./harness.mjs";
import { cut, small } from "./reach.mjs";
import { enterPose, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const at = tested();
const SEARCH_TIMEOUT_MS = 120_000; // a search renders some hundred frames, on a busy machine
const panelOf = (page) => page.getByRole("region", { name: "Where a real frame was taken" });

async function render(body) {
  const answer = await fetch(`${at.service.url}/v1/scenes/demo/render`, {
    method: "POST",
    headers: { "Content-Type": "application/json", Accept: "image/png" },
    body: JSON.stringify(body),
  });
  assert.equal(answer.status, 200);
  return Buffer.from(await answer.arrayBuffer());
}

function choose(page, name, buffer) {
  return panelOf(page).locator("input[type=file]").setInputFiles({ name, mimeType: "image/png", buffer });
}

async function openSearch(options) {
  const { page } = await openScan(at, options);
  await page.getByRole("button", { name: "Frame search: show or hide" }).click();
  await panelOf(page).scrollIntoViewIfNeeded();
  return page;
}

function moved({ position_mm, ...pose }, x, z) {
  return { ...pose, position_mm: { ...position_mm, x: position_mm.x + x, z: position_mm.z + z } };
}

describe("the search for a frame", () => {
  it("finds it about the present pose, shows both pictures, and goes there", async () => {
    const page = await openSearch();
    const taken = await poseOf(page);
    await choose(page, "real.png", await render({ pose: taken }));
    await panelOf(page).getByText("256 × 256 pixels").waitFor();
    await enterPose(page, JSON.stringify(moved(taken, 1.5, 1)));
    await page.getByRole("button", { name: "Search", exact: true }).click();
    await panelOf(page).getByText("Found.").waitFor({ timeout: SEARCH_TIMEOUT_MS });
    assert.ok(Number(await page.getByTestId("found-similarity").textContent()) > 0.9);
    await panelOf(page).getByRole("img", { name: "Rendered" }).waitFor();
    await panelOf(page).getByRole("button", { name: "Go there" }).click();
    const found = await until(() => poseOf(page), ({ position_mm: { x } }) => Math.abs(x - taken.position_mm.x) < 0.3, "it is elsewhere");
    assert.ok(Math.abs(found.position_mm.z - taken.position_mm.z) < 0.3, JSON.stringify(found));
    await picture(page, "locate-found");
    await panelOf(page).getByRole("button", { name: "Blend" }).click();
    await page.getByLabel("Share of the rendered picture", { exact: true }).fill("30");
    await panelOf(page).getByTestId("located").scrollIntoViewIfNeeded();
    await picture(page, "locate-blend");
    assert.deepEqual(await seriousFindings(page), []);
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("finds it from anywhere, without a start", async () => {
    const page = await openSearch();
    const taken = await poseOf(page);
    await choose(page, "real.png", await render({ pose: taken }));
    await enterPose(page, JSON.stringify(moved(taken, 12, 25)));
    await page.getByRole("checkbox", { name: "Anywhere along the sweep" }).check();
    assert.equal(await page.getByLabel("How far the probe may be off, mm", { exact: true }).count(), 0);
    await page.getByRole("button", { name: "Search", exact: true }).click();
    await panelOf(page).getByText("Found.").waitFor({ timeout: SEARCH_TIMEOUT_MS });
    await panelOf(page).getByRole("button", { name: "Go there" }).click();
    await until(() => poseOf(page), ({ position_mm: { x } }) => Math.abs(x - taken.position_mm.x) < 0.3, "it is elsewhere");
  });

  it("says that it was not found, and offers no pose then", async () => {
    const page = await openSearch();
    const pose = await poseOf(page);
    await choose(page, "elsewhere.png", await render({ pose: moved(pose, 0, 25) }));
    await page.getByRole("button", { name: "Search", exact: true }).click();
    await panelOf(page).getByText("Not found. Move the probe nearer").waitFor({ timeout: SEARCH_TIMEOUT_MS });
    assert.equal(await panelOf(page).getByRole("button", { name: "Go there" }).count(), 0);
    await picture(page, "locate-not-found");
    assert.deepEqual(await seriousFindings(page), []);
  });

  it("tells files that are no frame, and frames that were put on a screen", async () => {
    const page = await openSearch();
    await choose(page, "notes.png", Buffer.from("no picture"));
    await panelOf(page).getByText("notes.png is not a PNG file.").waitFor();
    const pose = await poseOf(page);
    const probe = { kind: "convex", opening_angle_deg: 60, near_mm: 40, far_mm: 90 };
    const fan = await render({ pose: moved(pose, 0, -40), probe, display: { pixel_mm: 0.25 } });
    await page.getByRole("combobox", { name: "Probe" }).selectOption("convex");
    await choose(page, "screen.png", fan);
    await panelOf(page).getByText("This looks like a picture of the screen").waitFor();
    await picture(page, "locate-fan");
    await choose(page, "stored.png", await render({ pose: moved(pose, 0, -40), probe }));
    await panelOf(page).getByText("stored.png").waitFor();
    assert.equal(await panelOf(page).getByText("This looks like a picture of the screen").count(), 0);
    await choose(page, "tiny.png", await render({ pose, height: 8, width: 8 }));
    await page.getByRole("button", { name: "Search", exact: true }).click();
    await panelOf(page).getByRole("alert").getByText(/32 pixels a side or more/).waitFor();
  });

  it("is stopped by the person, and has room for fingers", async () => {
    const page = await openSearch({ width: 1024, height: 768, touch: true });
    await choose(page, "real.png", await render({ pose: await poseOf(page) }));
    await page.route(/:localize$/, () => undefined); // a search that takes its time
    await page.getByRole("button", { name: "Search", exact: true }).click();
    await page.getByRole("button", { name: "Stop", exact: true }).click();
    await page.getByRole("button", { name: "Search", exact: true }).waitFor();
    assert.deepEqual(await small(page, 44), []);
    assert.deepEqual(await cut(page), []);
    await picture(page, "locate-touch");
    assert.deepEqual(page.faults, []);
  });
});
