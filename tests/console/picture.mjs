/** Draws docs/images/console.png, the README's picture of the console: a steered array on the demo scene. */

import path from "node:path";

import { ROOT, Service, canvasState, launch, until } from "./harness.mjs";
import { changed, IMAGE, openScan } from "./scan_page.mjs";

const PICTURE = path.join(ROOT, "docs/images/console.png");
const SETTLED_MS = 3_000; // the room's points and the last frame have come by then

const service = await Service.start();
const browser = await launch();
try {
  const { page } = await openScan({ browser, service }, { scheme: "dark" });
  await page.getByRole("combobox", { name: "Samples" }).selectOption("512");
  const { print } = await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
  await page.getByRole("combobox", { name: "Probe" }).selectOption("steered");
  await changed(page, print);
  await page.waitForTimeout(SETTLED_MS);
  await page.screenshot({ path: PICTURE });
} finally {
  await browser.close();
  await service.stop();
}
