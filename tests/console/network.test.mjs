/** Pages that browsers trust little, and connections that are refused, cut, dead or overloaded. */

import assert from "node:assert/strict";
import { after, describe, it } from "node:test";

import { canvasState, openPage, picture, seriousFindings, until } from "./harness.mjs";
import { Proxy } from "./proxy.mjs";
import { changed, IMAGE, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const MAX_SIDE = 512; // of images, in this service
const CUTS = 4;

let proxy;
const at = tested({
  environment: { ULTRAGRAY_MAX_IMAGE_SIDE: String(MAX_SIDE) },
  prepare: async ({ service }) => (proxy = await Proxy.start(service)),
});
after(() => proxy?.stop());

/** What browsers do to pages over plain HTTP from another machine. */
function distrust() {
  delete Navigator.prototype.getGamepads;
  Object.defineProperty(navigator, "clipboard", { value: undefined });
}

/** Counts the requests for what the scene says about itself. */
function countDescriptions(page) {
  const counted = { count: 0 };
  page.on("request", (request) => {
    if (new URL(request.url()).pathname === "/v1/scenes/demo") counted.count += 1;
  });
  return counted;
}

/** Counts the buffers that are made on the graphics card. */
function countBuffers() {
  globalThis.buffersMade = 0;
  const { createBuffer } = WebGL2RenderingContext.prototype;
  WebGL2RenderingContext.prototype.createBuffer = function () {
    globalThis.buffersMade += 1;
    return createBuffer.call(this);
  };
}

describe("a page that the browser does not trust", () => {
  it("shows Scan and Maps without gamepads, and offers the pose for copying by hand", async () => {
    const { page } = await openScan(at, { init: distrust });
    await page.getByLabel("Copy the pose as JSON").click();
    const alert = page.getByText("press Ctrl+C");
    await alert.waitFor();
    const selected = await page.evaluate(() => {
      const { value, selectionStart, selectionEnd } = document.activeElement;
      return value.slice(selectionStart, selectionEnd);
    });
    assert.deepEqual(JSON.parse(selected), await poseOf(page));
    await page.getByLabel("Pose as JSON, Enter applies").blur();
    await alert.waitFor({ state: "detached" });
    assert.equal(await page.getByTestId("place").innerText(), "view 106 of 211", "copying moved the probe");
    await page.getByRole("link", { name: "Maps", exact: true }).click();
    await until(() => canvasState(page, '[data-testid="map-echo"]'), ({ mean }) => mean > 1, "no map came");
    assert.deepEqual(page.faults, []);
  });
});

describe("a proxy", () => {
  it("that refuses streams is told, without asking for the scene all the time, and left when it takes them", async () => {
    proxy.refuses = true;
    const page = await openPage({ ...at, service: proxy }, "#/scenes");
    const descriptions = countDescriptions(page);
    await page.goto(`${proxy.url}/#/scan/demo`);
    await page.getByTestId("stream-barred").waitFor();
    assert.ok(descriptions.count >= 1 && descriptions.count <= 5, `asked ${descriptions.count} times`);
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "scan-barred");
    proxy.refuses = false;
    await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    await page.getByTestId("stream-barred").waitFor({ state: "detached" });
  });

  it("that cuts streams changes nothing in the 3D view, and the image follows again", async () => {
    const { page, first } = await openScan({ ...at, service: proxy }, { init: countBuffers });
    const buffersMade = () => page.evaluate(() => globalThis.buffersMade);
    let before = -1;
    let same = 0;
    const stands = (count) => {
      same = count > 8 && count === before ? same + 1 : 0;
      before = count;
      return same >= 5;
    };
    await page.getByTestId("room").locator("canvas").waitFor();
    await until(buffersMade, stands, "no 3D view");
    const descriptions = countDescriptions(page);
    for (let cut = 0; cut < CUTS; cut++) {
      const reconnected = page.waitForEvent("websocket").then((socket) => socket.waitForEvent("framereceived"));
      proxy.cut();
      await reconnected;
    }
    await page.getByLabel("Position Y", { exact: true }).fill("3");
    await changed(page, first.print);
    assert.ok(descriptions.count <= 2 * CUTS, `asked ${descriptions.count} times`);
    const made = (await buffersMade()) - before; // a part may be drawn for the first time; the whole view has dozens
    assert.ok(made < 10, `the 3D view was made anew: ${made} buffers`);
  });

  it("that lets a stream die silently does not stop the image for long", async () => {
    const page = await openPage({ ...at, service: proxy }, "#/scenes");
    await page.clock.install();
    await page.goto(`${proxy.url}/#/scan/demo`);
    const first = await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    proxy.silence();
    const reconnected = page.waitForEvent("websocket");
    await page.getByLabel("Position Y", { exact: true }).fill("3");
    await page.clock.fastForward(15_000);
    await reconnected;
    await changed(page, first.print);
  });
});

describe("a slow service", () => {
  it("is given more time for its frame after it was taken for dead", async () => {
    const page = await openPage(at, "#/scenes");
    await page.clock.install();
    let slow = false;
    const late = [];
    await page.routeWebSocket(/\/stream(\?|$)/, (socket) => {
      const there = socket.connectToServer();
      socket.onMessage((message) => {
        const isPose = "pose" in JSON.parse(message); // not the acknowledgement of a frame
        if (slow && isPose) late.push(() => there.send(message));
        else there.send(message);
      });
    });
    await page.goto(`${at.service.url}/#/scan/demo`);
    const first = await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    slow = true;
    await page.getByLabel("Position Y", { exact: true }).fill("3");
    await until(() => late.length, (asked) => asked === 1, "it is not asked");
    await page.clock.fastForward(11_000);
    await until(() => late.length, (asked) => asked === 2, "it is not asked again");
    await page.clock.fastForward(15_000);
    late[1]();
    await changed(page, first.print);
    assert.equal(late.length, 2);
  });
});

describe("a service that is asked too often", () => {
  it("is asked again when it says, and stays ready meanwhile", async () => {
    const page = await openPage(at, "#/scenes");
    await page.getByText("Service ready").waitFor();
    let refused = 0;
    let full = true;
    const refuse = async (route) => {
      if (!full) return route.continue();
      refused += 1;
      const problem = { type: "about:blank", status: 429, detail: "too many requests", reason: "RATE_LIMITED" };
      await route.fulfill({ status: 429, headers: { "Retry-After": "60" }, json: problem });
    };
    await page.clock.install();
    await page.route(/\/v1\/(scenes|statistics)\b/, refuse);
    await page.clock.runFor(5000);
    await page.getByText("too many requests Trying again.").waitFor();
    await until(() => refused, (count) => count === 2, "both are not asked");
    await page.clock.runFor(50_000);
    await page.getByText("Service ready").waitFor();
    assert.equal(refused, 2, "it was asked before it wanted to be");
    full = false;
    await page.clock.runFor(11_000);
    await page.getByText("too many requests").waitFor({ state: "detached" });
  });
});

it("aligns the clocks of page and service", async () => {
  const page = await openPage(at, "#/scenes");
  let header = { clock: null };
  page.on("websocket", (socket) => {
    socket.on("framereceived", ({ payload }) => {
      if (typeof payload !== "string") header = JSON.parse(payload.subarray(4, 4 + payload.readUInt32LE(0)).toString());
    });
  });
  await page.goto(`${at.service.url}/#/scan/demo`);
  const first = await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
  await page.getByLabel("Position Y", { exact: true }).fill("3");
  await changed(page, first.print);
  await until(() => header.clock, (clock) => clock !== null, "no offset was told");
  assert.ok(header.age_ms > 0);
});

describe("a refused pose", () => {
  for (const reason of ["QUEUE_FULL", "RATE_LIMITED"]) it(`is asked for again where the refusal may pass: ${reason}`, async () => {
    const page = await openPage(at, "#/scenes");
    let full = false;
    await page.routeWebSocket(/\/stream(\?|$)/, (socket) => {
      const there = socket.connectToServer();
      socket.onMessage((message) => {
        const { sequence } = JSON.parse(message);
        const error = { reason, detail: "too many frames wait", field: null };
        if (full) socket.send(JSON.stringify({ sequence, client_time_ms: null, dropped: 0, error }));
        else there.send(message);
      });
    });
    await page.goto(`${at.service.url}/#/scan/demo`);
    const first = await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    full = true;
    await page.getByLabel("Position Y", { exact: true }).fill("3");
    await page.getByTestId("refusal").getByText("too many frames wait").waitFor();
    full = false;
    await changed(page, first.print);
    await page.getByTestId("refusal").waitFor({ state: "detached" });
  });

  it("stays told while its settings are refused: the image before is not taken for theirs", async () => {
    const page = await openPage(at, "#/scenes");
    const refusals = [];
    page.on("websocket", (socket) => {
      socket.on("framereceived", ({ payload }) => {
        if (typeof payload === "string") refusals.push(payload);
      });
    });
    await page.goto(`${at.service.url}/#/scan/demo`);
    const first = await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    await page.getByRole("combobox", { name: "Image size" }).selectOption("768");
    await page.getByTestId("refusal").waitFor();
    const before = refusals.length;
    for (const y of ["0", "1", "2"]) await page.getByLabel("Position Y", { exact: true }).fill(y);
    await until(() => refusals.length, (count) => count >= before + 2, "the moves were not refused");
    await page.getByTestId("refusal").waitFor();
    assert.equal((await canvasState(page, IMAGE)).print, first.print, "an image with the settings before was shown");
    await page.getByRole("combobox", { name: "Image size" }).selectOption("256");
    await page.getByTestId("refusal").waitFor({ state: "detached" });
  });
});
