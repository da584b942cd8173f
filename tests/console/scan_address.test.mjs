/** Scan in the address: reload, links, Back, undo, keys, gestures, and sizes of the window. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { canvasState, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { changed, enterPose, IMAGE, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const at = tested();
const steerer = (page) => page.locator(`${IMAGE} .steer`);
const alike = (a, b) => Math.abs(a.mean - b.mean) < 0.05; // poses are rounded in addresses

/** Dispatches the pointers of fingers on the image. */
function touch(page, steps) {
  return steerer(page).evaluate((element, all) => {
    const box = element.getBoundingClientRect();
    for (const [type, pointerId, x, y] of all) {
      const clientX = box.left + x;
      const clientY = box.top + y;
      element.dispatchEvent(new PointerEvent(type, { pointerId, pointerType: "touch", clientX, clientY, bubbles: true, button: 0 }));
    }
  }, steps);
}

/** Pairs of texts on the image of which one lies on the other. */
function overlapping(page) {
  return page.locator(IMAGE).evaluate((image) => {
    const texts = [...image.querySelectorAll("svg text, [data-testid=confidence-badge] > *")].map((one) => {
      const range = document.createRange();
      range.selectNodeContents(one);
      return { text: one.textContent, box: range.getBoundingClientRect() };
    });
    const lieOver = (a, b) => a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1;
    const after = (index) => texts.slice(index + 1);
    return texts.flatMap((one, index) => after(index).filter((other) => lieOver(one.box, other.box)).map((other) => [one.text, other.text]));
  });
}

/** Without it, pointers that a script makes up cannot be captured. */
function withoutCapture() {
  Element.prototype.setPointerCapture = () => undefined;
}

describe("the worked cases", () => {
  it("open views of the demo scene by their address, with answers behind a click", async () => {
    const { page } = await openScan(at);
    await page.getByRole("button", { name: "Cases: show or hide" }).click();
    const cases = page.getByRole("region", { name: "What is this shadow?" });
    const links = await cases.getByRole("link").all();
    assert.equal(links.length, 6);
    let { print } = await canvasState(page, IMAGE);
    for (const [index, link] of links.entries()) {
      const answer = cases.getByRole("listitem").nth(index).locator("details");
      assert.equal(await answer.evaluate((element) => element.open), false, "the answer is told before it is asked for");
      await link.click();
      if (index > 0) ({ print } = await changed(page, print)); // the first is where the scene begins
      assert.equal(await page.getByTestId("link-refused").count(), 0);
    }
    await cases.getByText("Answer").first().click();
    const first = cases.locator("details").first();
    assert.deepEqual([await first.evaluate(({ open }) => open), (await first.textContent()).includes("Bone: the spinous process")], [true, true]);
    await picture(page, "scan-cases");
    assert.deepEqual(page.faults, []);
  });
});

describe("the address", () => {
  it("brings pose, probe and settings back after a reload and in another window", async () => {
    const { page } = await openScan(at);
    assert.doesNotMatch(page.url(), /\?/, "what is as usual stands in the address");
    await page.getByLabel("Gain", { exact: true }).fill("12");
    await page.getByRole("combobox", { name: "Probe" }).selectOption("convex");
    await until(() => canvasState(page, IMAGE), ({ width }) => width === 640, "no sector came");
    await page.getByLabel("Opening angle", { exact: true }).fill("50");
    await page.getByLabel("Position Y", { exact: true }).fill("4");
    await page.getByLabel("Flip").check();
    const pose = await poseOf(page);
    await page.getByRole("button", { name: "Copy link" }).click();
    const link = await page.evaluate(() => navigator.clipboard.readText());
    const other = await openPage(at, new URL(link).hash);
    const showTheSame = (problem) =>
      until(() => Promise.all([page, other].map((one) => canvasState(one, IMAGE))), ([one, another]) => one.width > 256 && one.width === another.width && alike(one, another), problem);
    await showTheSame("the link shows another image");
    await until(() => page.url(), (url) => url.includes("flip=true"), "the address does not tell it");
    await page.reload();
    await showTheSame("another image came after the reload");
    assert.deepEqual(await poseOf(page), pose);
    assert.equal(await other.getByLabel("Gain", { exact: true }).inputValue(), "12");
    assert.deepEqual([page.faults, other.faults], [[], []]);
  });

  it("has a step for each jump, which Back undoes and Forward does again", async () => {
    const { page, first } = await openScan(at);
    await enterPose(page, '{"position_mm": {"x": 2, "y": 4, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}');
    const typed = await changed(page, first.print);
    await page.getByRole("button", { name: "Snap" }).click();
    await changed(page, typed.print);
    const snapped = await until(() => poseOf(page), ({ position_mm: { x } }) => x !== 2, "the pose does not snap");
    await page.goBack();
    await until(() => poseOf(page), ({ position_mm: { x, y } }) => x === 2 && y === 4, "Back does not undo the snap");
    await page.goBack();
    await until(() => canvasState(page, IMAGE), (state) => alike(state, first), "Back does not undo the typed pose");
    await page.goForward();
    await page.goForward();
    await until(() => poseOf(page), (pose) => JSON.stringify(pose) === JSON.stringify(snapped), "Forward does not do it again");
  });

  it("that holds what cannot be used says so in a sentence", async () => {
    const page = await openPage(at, "#/scan/demo?gain_db=900&pose=1_2_3&probe=banana&tgc_db=3_x&flip=true");
    const notice = page.getByTestId("link-refused");
    await notice.getByText("values that cannot be used").waitFor();
    for (const told of ["gain_db=900 (-100 to 100)", "pose=1_2_3 (seven numbers", "probe=banana (one of convex", "tgc_db=3_x (not a number)"])
      assert.ok((await notice.textContent()).includes(told), told);
    await page.getByLabel("Flip").and(page.locator(":checked")).waitFor();
    await picture(page, "scan-link-refused");
    await notice.getByRole("button", { name: "Close" }).click();
    await until(() => page.url(), (url) => url.endsWith("#/scan/demo?flip=true"), "what is no use stays in the address");
  });

  it("of the view is left and come back to with its settings", async () => {
    const { page } = await openScan(at);
    await page.getByLabel("Gain", { exact: true }).fill("9");
    await until(() => page.url(), (url) => url.endsWith("gain_db=9"), "the gain is not in the address");
    await page.getByRole("link", { name: "Train", exact: true }).click();
    await page.getByRole("link", { name: "Scan", exact: true }).click();
    await until(() => page.url(), (url) => url.endsWith("#/scan/demo?gain_db=9"), "the gain is lost");
  });
});

describe("undo", () => {
  it("takes steering without a pause as one step, and does it again", async () => {
    const { page } = await openScan(at);
    const pose = await poseOf(page);
    await steerer(page).focus();
    await page.keyboard.down("ArrowRight");
    await page.waitForTimeout(600);
    await page.keyboard.up("ArrowRight");
    await page.waitForTimeout(700);
    const moved = await poseOf(page);
    await page.getByRole("button", { name: "Home" }).click();
    await page.keyboard.press("Control+z");
    await until(() => poseOf(page), (now) => JSON.stringify(now) === JSON.stringify(moved), "Home is not undone");
    await page.keyboard.press("Control+z");
    await until(() => poseOf(page), (now) => JSON.stringify(now) === JSON.stringify(pose), "steering is more than a step");
    assert.equal(await page.getByRole("button", { name: "Undo" }).isDisabled(), true);
    await page.getByRole("button", { name: "Redo" }).click();
    await until(() => poseOf(page), (now) => JSON.stringify(now) === JSON.stringify(moved), "it is not done again");
  });
});

describe("keys", () => {
  it("are told in a dialog, can be turned off, and a gamepad has buttons for them", async () => {
    const { page } = await openScan(at);
    await page.keyboard.press("?");
    const dialog = page.getByRole("dialog", { name: "Keys and gestures" });
    await dialog.getByText("Freeze and unfreeze").waitFor();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "scan-keys");
    await dialog.getByLabel(/Single keys do something/).uncheck();
    await page.keyboard.press("Escape");
    await page.keyboard.press("f");
    await page.waitForTimeout(200);
    const pressed = () => page.getByRole("button", { name: "Freeze" }).getAttribute("aria-pressed");
    assert.equal(await pressed(), "false", "F does something although it is off");
    await page.evaluate(() => {
      const buttons = Array.from({ length: 12 }, () => ({ pressed: false, value: 0 }));
      const pad = { id: "Pad", connected: true, axes: [0, 0, 0, 0], buttons };
      navigator.getGamepads = () => [pad];
      dispatchEvent(new Event("gamepadconnected"));
      setTimeout(() => (buttons[0] = { pressed: true, value: 1 }), 100);
    });
    await until(pressed, (now) => now === "true", "the button of the gamepad does not freeze");
  });

  it("steer at the speed that was chosen", async () => {
    const { page } = await openScan(at);
    const tap = async () => {
      const { position_mm: before } = await poseOf(page);
      await page.evaluate(() => {
        for (const type of ["keydown", "keyup"]) document.activeElement.dispatchEvent(new KeyboardEvent(type, { key: "ArrowRight", bubbles: true }));
      });
      const { position_mm: after } = await until(() => poseOf(page), (pose) => pose.position_mm.x !== before.x, "it is not steered");
      return after.x - before.x;
    };
    await steerer(page).focus();
    const usual_mm = await tap();
    await page.keyboard.press("+");
    await page.keyboard.press("+");
    const fast_mm = await tap();
    assert.ok(Math.abs(fast_mm - 4 * usual_mm) < 0.05, `${fast_mm} mm after ${usual_mm} mm`);
  });
});

describe("dragging on the image", () => {
  it("slides with the mouse, turns with Shift and with the right button", async () => {
    const { page } = await openScan(at);
    const before = await poseOf(page);
    const box = await page.locator(`${IMAGE} canvas`).boundingBox();
    const drag = async (button) => {
      await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
      await page.mouse.down({ button });
      await page.mouse.move(box.x + box.width * 0.6, box.y + box.height / 2, { steps: 4 });
      await page.mouse.up({ button });
    };
    await drag("left");
    await until(() => poseOf(page), ({ position_mm: { x } }) => Math.abs(x - before.position_mm.x - 6) < 0.3, "it does not follow the pointer");
    const slid = await poseOf(page);
    await page.keyboard.down("Shift");
    await drag("left");
    await page.keyboard.up("Shift");
    const turned = await until(() => poseOf(page), ({ quaternion }) => quaternion.z > slid.quaternion.z + 0.01, "Shift does not turn");
    await drag("right");
    await until(() => poseOf(page), ({ quaternion }) => quaternion.z > turned.quaternion.z + 0.01, "the right button does not turn");
  });

  it("with two fingers rotates and rocks, and a pinch sets the depth", async () => {
    const { page } = await openScan(at, { init: withoutCapture });
    const before = await poseOf(page);
    await touch(page, [["pointerdown", 1, 100, 200], ["pointerdown", 2, 200, 200], ["pointermove", 1, 100, 180], ["pointermove", 2, 200, 220], ["pointermove", 1, 100, 160], ["pointermove", 2, 200, 240], ["pointerup", 1, 100, 160], ["pointerup", 2, 200, 240]]);
    await until(() => poseOf(page), ({ quaternion }) => Math.abs(quaternion.z - before.quaternion.z) > 0.05, "twisting does not rotate");
    await touch(page, [["pointerdown", 1, 100, 200], ["pointerdown", 2, 200, 200], ["pointermove", 1, 60, 200], ["pointermove", 2, 240, 200], ["pointermove", 1, 50, 200], ["pointerup", 1, 50, 200], ["pointerup", 2, 240, 200]]);
    const depth = page.getByLabel("Depth", { exact: true });
    await until(async () => Number(await depth.inputValue()), (mm) => mm > 20 && mm < 45, "a pinch does not set the depth");
    const pinched = await poseOf(page);
    await touch(page, [["pointerdown", 1, 100, 200], ["pointermove", 1, 140, 200], ["pointerup", 1, 140, 200]]);
    await until(() => poseOf(page), ({ position_mm }) => position_mm.x !== pinched.position_mm.x, "a finger does not slide");
  });
});

describe("the window", () => {
  it("of a laptop shows the large image at 700 pixels, with the scene beside it", async () => {
    const { page } = await openScan(at, { width: 1280, height: 800 });
    await page.keyboard.press("l");
    const box = await until(() => page.locator(`${IMAGE} canvas`).boundingBox(), ({ height }) => height > 600, "it is not large");
    assert.ok(Math.max(box.width, box.height) >= 700, `${box.width} x ${box.height}`);
    assert.deepEqual(await overlapping(page), []);
    await page.getByLabel("Flip", { exact: true }).check();
    await page.locator('[data-testid="orientation-marker"][data-side="right"]').waitFor();
    assert.deepEqual(await overlapping(page), [], "mirrored");
    await page.getByTestId("room").waitFor();
    await picture(page, "scan-large");
    assert.deepEqual(await seriousFindings(page), []);
    await page.keyboard.press("l");
    await until(() => page.locator(`${IMAGE} canvas`).boundingBox(), ({ height }) => height < 600, "it stays large");
  });

  it("of a tablet has room for the image, and no text of the image lies on another", async () => {
    const { page } = await openScan(at, { width: 1024, height: 768, touch: true });
    const box = await page.locator(`${IMAGE} canvas`).boundingBox();
    assert.ok(Math.min(box.width, box.height) >= 320, `${box.width} x ${box.height}`);
    assert.deepEqual(await overlapping(page), []);
    await picture(page, "scan-tablet");
    await enterPose(page, JSON.stringify({ position_mm: { x: 0, y: -19, z: 0 }, quaternion: { w: 0.866, x: 0.5, y: 0, z: 0 } }));
    await page.getByTestId("confidence-frame").waitFor();
    assert.deepEqual(await overlapping(page), [], "where it is a guess");
  });

  it("of any size shows all without sideways scrolling, and groups close", async () => {
    for (const [width, height, scheme] of [[1920, 1080, "dark"], [1280, 800, "light"], [1024, 768, "dark"], [768, 1024, "light"], [640, 400, "light"], [390, 844, "dark"]]) {
      const { page } = await openScan(at, { width, height, scheme });
      const wider = await page.locator(".scan").evaluate((scan) => {
        const cut = [...scan.querySelectorAll("button, select, input:not(.visually-hidden), h2")].filter((one) => {
          const box = one.getBoundingClientRect();
          const { left, right } = scan.getBoundingClientRect();
          return box.width > 0 && (box.right > right + 1 || box.left < left - 1);
        });
        return [scan.scrollWidth > scan.clientWidth, cut.map((one) => one.ariaLabel ?? one.textContent)];
      });
      assert.deepEqual(wider, [false, []], `at ${width} pixels`);
      assert.deepEqual(await overlapping(page), [], `at ${width} pixels`);
      await picture(page, `scan-${width}`);
      await page.context().close();
    }
    const { page } = await openScan(at);
    await page.getByRole("button", { name: "Image: show or hide" }).click();
    await page.getByLabel("Gain", { exact: true }).waitFor({ state: "hidden" });
    await page.reload();
    await page.getByRole("button", { name: "Pose: show or hide" }).waitFor();
    assert.equal(await page.getByLabel("Gain", { exact: true }).isVisible(), false, "it opens again");
  });
});
