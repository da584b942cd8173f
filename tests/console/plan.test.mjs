/** Where to look next: planned by the service, listed with its gains, drawn in space, gone to; refused in words. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { picture, seriousFindings, until } from "./harness.mjs";
import { openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const at = tested();
const PLAN_TIMEOUT_MS = 120_000; // on a busy machine
const panelOf = (page) => page.getByRole("region", { name: "Views that would teach the scene most" });

async function openPlan() {
  const { page } = await openScan(at);
  await page.getByRole("button", { name: "Plan: show or hide" }).click();
  await panelOf(page).scrollIntoViewIfNeeded();
  return page;
}

/** Pixels of the 3D view, as they are now. */
const spaceOf = (page) => page.getByTestId("space").screenshot();

describe("the plan of views", () => {
  it("is listed in the order of the way, drawn in space, and gone to", async () => {
    const page = await openPlan();
    const before = await poseOf(page);
    const bare = await spaceOf(page);
    await panelOf(page).getByRole("spinbutton", { name: "Views" }).fill("4");
    await page.keyboard.press("Tab");
    await panelOf(page).getByRole("button", { name: "Plan views" }).click();
    await panelOf(page).getByText(/4 views, .* mm of way/).waitFor({ timeout: PLAN_TIMEOUT_MS });
    const views = panelOf(page).getByTestId("planned").getByRole("button");
    assert.equal(await views.count(), 4);
    const ranks = (await views.allTextContents()).map((text) => Number(/gain number (\d)/.exec(text)[1]));
    assert.deepEqual(ranks.toSorted(), [1, 2, 3, 4]);
    await until(() => spaceOf(page), (now) => !now.equals(bare), "the plan is not drawn");
    await picture(page, "plan");
    await views.first().click();
    await until(() => poseOf(page), (pose) => JSON.stringify(pose) !== JSON.stringify(before), "the probe stays");
    assert.deepEqual(await seriousFindings(page), []);
    await panelOf(page).getByRole("button", { name: "Forget" }).click();
    await panelOf(page).getByTestId("planned").waitFor({ state: "detached" });
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("says in words why there is none", async () => {
    const page = await openPlan();
    await panelOf(page).getByRole("textbox", { name: "Box" }).fill("900:910,0:5,0:5");
    await page.keyboard.press("Tab");
    await panelOf(page).getByRole("button", { name: "Plan views" }).click();
    await panelOf(page).getByRole("alert").getByText(/no pose is in reach/).waitFor({ timeout: PLAN_TIMEOUT_MS });
  });
});
