/** Measures the console: frames a second, first paint, clicks in 3D, growth of the heap, size of the bundle.
 *
 * node tests/console/measure.mjs [SECONDS]: a sweep is played at 512x512 beside the 3D view for so long (default 600). Prints JSON.
 */

import { execFileSync } from "node:child_process";
import { readdirSync, readFileSync, statSync } from "node:fs";
import path from "node:path";
import { gzipSync } from "node:zlib";

import { clicksShownAfter_ms, watchDrawing } from "./drawing.mjs";
import { canvasState, launch, openPage, PYTHON, ROOT, Service, until } from "./harness.mjs";

const IMAGE = '[aria-label="Live image"]';
const SAMPLE_S = 10;
const WARM_UP_S = 20; // the cine loop fills, the compiler of the browser settles
const CLICKS = 21;
const MEBIBYTE = 2 ** 20;
const seconds = Number(process.argv[2] ?? 600);

function bundleBytes(folder = path.join(ROOT, "service/ultragray_service/console")) {
  return readdirSync(folder, { recursive: true })
    .map((name) => path.join(folder, name))
    .filter((file) => statSync(file).isFile())
    .reduce((sum, file) => sum + gzipSync(readFileSync(file)).length, 0);
}

async function firstPaint_ms(page) {
  return page.evaluate(() => performance.getEntriesByName("first-contentful-paint")[0]?.startTime);
}

/** Bytes of the heap and of array buffers after a collection. */
async function heapBytes(session) {
  await session.send("HeapProfiler.collectGarbage");
  const { usedSize, backingStorageSize = 0 } = await session.send("Runtime.getHeapUsage");
  return usedSize + backingStorageSize;
}

/** How soon clicks in 3D show while the sweep plays, in a page of its own: noting what is drawn takes memory. */
async function clicksWhilePlaying_ms() {
  const page = await openPage({ browser, service }, "#/scan/demo", { init: `(${watchDrawing})()` });
  await page.getByTestId("legend").waitFor();
  await page.getByText("refining …").waitFor({ state: "detached" });
  await page.getByRole("button", { name: "Options" }).click();
  await page.getByRole("button", { name: "Play the sweep" }).click();
  await page.waitForTimeout(WARM_UP_S * 1000);
  return clicksShownAfter_ms(page, CLICKS);
}

const service = await Service.start();
const browser = await launch();
try {
  const cold = await openPage({ browser, service }, "#/scan/demo");
  await until(() => canvasState(cold, IMAGE), ({ mean }) => mean > 5, "no frame came");
  const paint_ms = await firstPaint_ms(cold);
  const image_ms = await cold.evaluate(() => performance.now());
  await cold.context().close();

  const page = await openPage({ browser, service }, "#/scan/demo");
  await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came"); // a scene that is not known yet begins anew
  await page.getByTestId("legend").waitFor();
  await page.getByRole("combobox", { name: "Image size" }).selectOption("512");
  await until(() => canvasState(page, IMAGE), ({ width }) => width === 512, "no 512 scan lines");
  await page.evaluate(() => {
    const put = CanvasRenderingContext2D.prototype.putImageData;
    globalThis.drawn = 0;
    CanvasRenderingContext2D.prototype.putImageData = function (...given) {
      globalThis.drawn += 1;
      return put.apply(this, given);
    };
  });
  const session = await page.context().newCDPSession(page);
  await session.send("HeapProfiler.enable");
  await page.getByRole("button", { name: "Play the sweep" }).click();
  await page.waitForTimeout(Math.min(WARM_UP_S, seconds / 2) * 1000);
  const heaps = [await heapBytes(session)];
  const rates = [];
  for (let passed = 0; passed < seconds; passed += SAMPLE_S) {
    const [drawn, start] = await page.evaluate(() => [globalThis.drawn, performance.now()]);
    await page.waitForTimeout(SAMPLE_S * 1000);
    const [later, end] = await page.evaluate(() => [globalThis.drawn, performance.now()]);
    rates.push(((later - drawn) * 1000) / (end - start));
    heaps.push(await heapBytes(session));
  }
  await page.context().close();
  const clicks_ms = await clicksWhilePlaying_ms();
  const sorted = [...rates].sort((a, b) => a - b);
  const rounded = (value) => Math.round(value * 10) / 10;
  const heaps_mib = heaps.map((bytes) => rounded(bytes / MEBIBYTE));
  const figures = {
    measured: JSON.parse(execFileSync(PYTHON, ["-m", "ultragray_studies.bench.report"])),
    seconds,
    frames_per_s: { median: rounded(sorted[sorted.length >> 1]), least: rounded(sorted[0]), most: rounded(sorted.at(-1)) },
    heap_mib: { first: heaps_mib[0], last: heaps_mib.at(-1), most: Math.max(...heaps_mib) },
    click_in_3d_ms: { median: rounded(clicks_ms[clicks_ms.length >> 1]), most: rounded(clicks_ms.at(-1)) },
    first_contentful_paint_ms: rounded(paint_ms),
    first_image_ms: rounded(image_ms),
    bundle_gzip_kb: rounded(bundleBytes() / 1000),
  };
  process.stdout.write(`${JSON.stringify(figures, null, 2)}\n`);
} finally {
  await browser.close();
  await service.stop();
}
