/** Registrations: listed, chosen so that poses are those of the robot, and deleted. */

import assert from "node:assert/strict";
import { copyFileSync } from "node:fs";
import path from "node:path";
import { describe, it } from "node:test";

import { picture, seriousFindings, until } from "./harness.mjs";
import { cut, small } from "./reach.mjs";
import { enterPose, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

/** The base looks down on the scene from 168 mm above; the flange is 142 mm behind the face. */
const BASE_TO_SCENE = [[1, 0, 0, -400], [0, -1, 0, 20], [0, 0, -1, 168], [0, 0, 0, 1]];
const PROBE_TO_FLANGE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 142], [0, 0, 0, 1]];

const at = tested({
  prepare: async ({ service }) => {
    copyFileSync(path.join(service.data, "demo.ugr"), path.join(service.data, "second.ugr"));
    const put = async (name, body) => {
      const answer = await fetch(`${service.url}/v1/registrations/${name}`, { method: "PUT", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } });
      assert.ok(answer.ok, await answer.text());
    };
    const registration = { base_to_scene: BASE_TO_SCENE, probe_to_flange: PROBE_TO_FLANGE };
    await put("robot", { ...registration, scene: "demo", residual_mm: 0.412, residual_deg: 0.2 });
    await put("tracker", { ...registration, scene: "demo" });
  },
});
const panelOf = (page) => page.getByRole("region", { name: "Registrations", exact: true });

async function openPanel(options) {
  const { page } = await openScan(at, options);
  await page.getByRole("button", { name: "Registrations: show or hide" }).click();
  await panelOf(page).getByText("robot", { exact: true }).waitFor();
  return page;
}

describe("the registrations", () => {
  it("are listed with their residuals, and tell poses as the robot does", async () => {
    const page = await openPanel();
    await page.getByTestId("registration-robot").getByText("residual 0.41 mm, 0.20°").waitFor();
    await page.getByTestId("registration-tracker").getByText("residual not told").waitFor();
    await enterPose(page, '{"position_mm": {"x": 0, "y": 0, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}');
    await until(() => poseOf(page), ({ position_mm: { y } }) => y === 0, "the pose was not taken");
    await panelOf(page).getByRole("radio", { name: "robot" }).check();
    // worked out by hand: the face at the scene's origin, the flange 142 mm above it, turned about x by 180°
    await until(() => poseOf(page), ({ position_mm: { x, y, z } }) => x === 400 && y === 20 && z === 310, "not the flange in the base");
    assert.deepEqual((await poseOf(page)).quaternion, { w: 0, x: 1, y: 0, z: 0 });
    await page.getByText("Position of the flange, as robot tells it").waitFor();
    assert.equal(await page.getByLabel("Position Z, mm", { exact: true }).inputValue(), "310.0");
    await picture(page, "registrations");
    assert.deepEqual(await seriousFindings(page), []);

    await enterPose(page, '{"position_mm": {"x": 402, "y": 15, "z": 309}, "quaternion": {"w": 0, "x": 1, "y": 0, "z": 0}}');
    await panelOf(page).getByRole("radio", { name: "of the probe, in the scene" }).check();
    await until(() => poseOf(page), ({ position_mm: { x, y, z } }) => x === 2 && y === 5 && z === 1, "the flange's pose did not lead there");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("are followed where they are changed at the service, and told where they are gone", async () => {
    const address = `${at.service.url}/v1/registrations/moved`;
    const put = async (base, scene = "demo") => {
      const body = JSON.stringify({ scene, base_to_scene: base, probe_to_flange: PROBE_TO_FLANGE });
      assert.ok((await fetch(address, { method: "PUT", body, headers: { "Content-Type": "application/json" } })).ok);
    };
    await put(BASE_TO_SCENE);
    const page = await openPanel();
    await enterPose(page, '{"position_mm": {"x": 0, "y": 0, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}');
    await panelOf(page).getByRole("radio", { name: "moved" }).check();
    await until(() => poseOf(page), ({ position_mm: { x } }) => x === 400, "not the flange in the base");
    await put(BASE_TO_SCENE.map(([a, b, c, d], row) => [a, b, c, row === 0 ? d - 7 : d]));
    await until(() => poseOf(page), ({ position_mm: { x } }) => x === 407, "the pose is still told by what was stored before", 20_000);
    assert.ok((await fetch(address, { method: "DELETE" })).ok);
    await panelOf(page).getByText("moved is not stored any more: poses are those of the probe again.").waitFor({ timeout: 20_000 });
    await until(() => poseOf(page), ({ position_mm: { x } }) => x === 0, "the pose is still the flange's");
    await put(BASE_TO_SCENE);
    await panelOf(page).getByRole("radio", { name: "moved" }).check({ timeout: 20_000 });
    await until(() => poseOf(page), ({ position_mm: { x } }) => x === 400, "not the flange in the base");
    await put(BASE_TO_SCENE, "second");
    const elsewhere = panelOf(page).getByText("moved is of the scene second now: poses are those of the probe again.");
    await elsewhere.waitFor({ timeout: 20_000 });
    await until(() => poseOf(page), ({ position_mm: { x } }) => x === 0, "the pose is still the flange's");
    await put(BASE_TO_SCENE);
    await elsewhere.waitFor({ state: "detached", timeout: 20_000 });
    assert.ok((await fetch(address, { method: "DELETE" })).ok);
  });

  it("move the probe by the numbers of the flange", async () => {
    const page = await openPanel();
    await enterPose(page, '{"position_mm": {"x": 0, "y": 0, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}');
    await panelOf(page).getByRole("radio", { name: "robot" }).check();
    const field = page.getByLabel("Position Y, mm", { exact: true });
    await field.fill("14");
    await field.press("Enter");
    await until(() => poseOf(page), ({ position_mm: { y } }) => y === 14, "it did not move");
    await panelOf(page).getByRole("radio", { name: "of the probe, in the scene" }).check();
    const { position_mm, quaternion } = await until(() => poseOf(page), ({ position_mm: { y } }) => y === 6, "it went the wrong way");
    assert.deepEqual([position_mm.x, position_mm.z, quaternion.w], [0, 0, 1]);
  });

  it("are deleted once that is confirmed; poses are then those of the probe again", async () => {
    const page = await openPanel({ width: 1024, height: 768, touch: true });
    assert.deepEqual(await small(page, 44), []);
    assert.deepEqual(await cut(page), []);
    const row = page.getByTestId("registration-tracker");
    await row.getByRole("radio").check();
    await page.getByTestId("pose-registered").getByText("by tracker").waitFor();
    await row.getByRole("button", { name: "Delete" }).click();
    await row.getByText("Delete tracker?").waitFor();
    await row.scrollIntoViewIfNeeded();
    await picture(page, "registrations-delete");
    await row.getByRole("button", { name: "Delete" }).click();
    await row.waitFor({ state: "detached" });
    assert.equal(await page.getByTestId("pose-registered").count(), 0);
    const { registrations } = await (await fetch(`${at.service.url}/v1/registrations`)).json();
    assert.deepEqual(registrations.map(({ name }) => name), ["robot"]);
    assert.deepEqual(page.faults, []);
  });
});
