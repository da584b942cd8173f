/** Frames that the console renders itself: at once, compared with the service's, and on while the service is away. */

import assert from "node:assert/strict";
import { existsSync } from "node:fs";
import path from "node:path";
import { after, before, describe, it } from "node:test";

import { launchFirefox, missing, openInFirefox, stateInFirefox } from "./firefox.mjs";
import { canvasState, picture, ROOT, seriousFindings, Service, until } from "./harness.mjs";
import { changed, IMAGE, openScan } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const KEY = "0123456789abcdef-local";
const isBuilt = existsSync(path.join(ROOT, "model/ultragray/exchange/page/ultragray.wasm"));
const skip = isBuilt ? false : "the renderer for pages is not built: make browser";

const TOLD = /differ by|pixel by pixel/;
const AS_GOOD_AS_SAME = /pixel by pixel|at most 1 of 255 grey levels, by 0\.00\d on average/;

const at = tested({ environment: { ULTRAGRAY_API_KEYS: KEY } });
const withKey = { init: `sessionStorage.setItem("ultragray.key", ${JSON.stringify(KEY)})` };

async function openLocal(source) {
  const opened = await openScan(at, withKey);
  await opened.page.getByLabel("Frames from").selectOption(source);
  return opened;
}

const said = (page, words) => page.getByTestId("local-frames").getByText(words).waitFor();

describe("frames of the page itself", { skip }, () => {
  it("are those of the service, and the console says by how much they differ", async () => {
    const { page } = await openLocal("both");
    await said(page, /MB, and renders the image itself/);
    await page.getByLabel("Position Y", { exact: true }).fill("3");
    const text = await until(() => page.getByTestId("local-frames").innerText(), (now) => TOLD.test(now), "no difference is told");
    assert.match(text, AS_GOOD_AS_SAME);
    await page.getByTestId("local-frames").scrollIntoViewIfNeeded();
    assert.deepEqual(await seriousFindings(page), []);
    await picture(page, "scan-both");
    assert.deepEqual([page.faults, page.foreign], [[], []]);
  });

  it("are shown while the service holds its own back, whose frame then takes the place of the page's", async () => {
    const { page } = await openScan(at, withKey);
    const late = [];
    let slow = false;
    await page.routeWebSocket(/\/stream(\?|$)/, (socket) => {
      const there = socket.connectToServer();
      socket.onMessage((message) => (slow && "pose" in JSON.parse(message) ? late.push(() => there.send(message)) : there.send(message)));
    });
    await page.reload();
    const first = await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    await page.getByLabel("Frames from").selectOption("both");
    await said(page, TOLD);
    slow = true;
    await page.getByLabel("Position Y", { exact: true }).fill("3");
    await changed(page, first.print);
    await page.getByTestId("confidence-badge").getByText(/expected similarity/).waitFor();
    assert.match(await page.getByTestId("service-renderer").innerText(), /^page$/);
    for (const send of late) send();
    await page.getByTestId("service-renderer").getByText(/cpu/).waitFor();
  });

  it("follow the probe while the service is away, which the console says", async () => {
    const { page } = await openLocal("page");
    await said(page, /MB, and renders the image itself/);
    await at.service.down();
    try {
      await page.getByTestId("service-down-local").waitFor();
      const before = await canvasState(page, IMAGE);
      await page.getByLabel("Position Y", { exact: true }).fill("7");
      const moved = await changed(page, before.print);
      await page.getByRole("link", { name: "Maps", exact: true }).click();
      await page.getByRole("link", { name: "Scan", exact: true }).click();
      await until(() => canvasState(page, IMAGE), ({ print }) => print === moved.print, "the view that was left does not come back");
      await page.getByText(/· Live/).waitFor();
      await picture(page, "scan-away");
    } finally {
      await at.service.up();
    }
    await page.getByTestId("service-down-local").waitFor({ state: "detached" });
  });
});

describe("where the renderer is not there", () => {
  it("the console says who can build it, and shows the service's frames", async () => {
    const { page, first } = await openScan(at, withKey);
    await page.route(/\/package\//, (route) => route.fulfill({ status: 404 }));
    await page.getByLabel("Frames from").selectOption("both");
    await said(page, /make browser/);
    await page.getByLabel("Position Y", { exact: true }).fill("3");
    await changed(page, first.print);
  });
});

describe("in Firefox", { skip: skip || (missing ?? false) }, () => {
  const there = {};
  before(async () => {
    there.service = await Service.start();
    there.browser = await launchFirefox();
  });
  after(async () => {
    await there.browser?.close();
    await there.service?.stop();
  });

  it("frames of the page are those of the service", async () => {
    const page = await openInFirefox(there, "#/scan/demo");
    await until(() => stateInFirefox(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
    await page.evaluate(() => {
      const select = [...document.querySelectorAll("label")].find((label) => /Frames from/.test(label.textContent)).querySelector("select");
      select.value = "both";
      select.dispatchEvent(new Event("change", { bubbles: true }));
    });
    const text = await until(
      () => page.$eval('[data-testid="local-frames"]', (element) => element.textContent),
      (now) => TOLD.test(now),
      "no difference is told",
    );
    assert.match(text, AS_GOOD_AS_SAME);
    assert.deepEqual(await page.evaluate(() => globalThis.refusedSources.filter((source) => !/^data:font/.test(source))), []);
  });
});
