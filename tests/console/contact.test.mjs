/** Contact with the skin on the image: off it scan lines are dark where that is asked for, and the share in contact is told. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { canvasState, picture, seriousFindings, until } from "./harness.mjs";
import { changed, enterPose, IMAGE, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const at = tested();
const LIFTED_MM = 6; // more than gel fills
const choice = (page) => page.getByRole("combobox", { name: "Off the skin" });
const share = (page) => page.getByTestId("contact-share");

/** Scan with the probe lifted off the skin. */
async function openLifted() {
  const { page, first } = await openScan(at);
  const pose = await poseOf(page);
  pose.position_mm.z -= LIFTED_MM;
  await enterPose(page, JSON.stringify(pose));
  const lifted = await changed(page, first.print);
  assert.ok(lifted.mean > 5, "it is dark though nobody asked for it");
  return page;
}

describe("contact with the skin", () => {
  it("is assumed until it is asked for; then the image of a lifted probe is dark, and says why", async () => {
    const page = await openLifted();
    assert.equal(await share(page).count(), 0);
    await choice(page).selectOption({ label: "Dark" });
    await until(() => canvasState(page, IMAGE), ({ mean }) => mean < 0.5, "it is not dark");
    await until(() => share(page).textContent(), (text) => text === "0 %", "the share is another");
    await page.getByTestId("confidence-badge").getByText("contact 0 %").waitFor();
    await picture(page, "contact-lifted");
    assert.deepEqual(await seriousFindings(page), []);

    await until(() => page.url(), (url) => url.includes("contact=air"), "the address does not tell it");
    await page.reload();
    await until(() => choice(page).inputValue(), (value) => value === "air", "it is forgotten");
    await page.getByRole("button", { name: "Home" }).click();
    await until(() => share(page).textContent(), (text) => text === "100 %", "a view of the sweep has no contact");

    await choice(page).selectOption({ label: "Contact assumed" });
    await page.reload();
    await until(() => choice(page).inputValue(), (value) => value !== "air", "a reload right after a change undid it");
    await share(page).waitFor({ state: "detached" });
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("is lost by a part of the scan lines where the probe is rocked", async () => {
    const { page } = await openScan(at);
    await choice(page).selectOption({ label: "Dark; pressed tissue gives way" });
    await until(() => share(page).textContent(), (text) => text === "100 %", "it is not told");
    const pose = await poseOf(page);
    await enterPose(page, JSON.stringify({ ...pose, quaternion: { w: Math.cos(0.1), x: 0, y: Math.sin(0.1), z: 0 } }));
    await until(() => share(page).textContent(), (text) => parseInt(text) > 20 && parseInt(text) < 90, "it is all or nothing");
    await picture(page, "contact-rocked");
  });
});
