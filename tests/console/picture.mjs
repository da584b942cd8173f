/** Draws the documents' pictures of the console, on the demo scene: a steered array, a needle, a cyst that is put in, and Maps. */

import path from "node:path";

import { ROOT, Service, canvasState, launch, openPage, until } from "./harness.mjs";
import { changed, IMAGE, openScan } from "./scan_page.mjs";

const PICTURES = path.join(ROOT, "docs/images");
const SETTLED_MS = 3_000; // the room's points and the last frame have come by then

const service = await Service.start();
const browser = await launch();
try {
  const { page } = await openScan({ browser, service }, { scheme: "dark" });
  await page.getByRole("combobox", { name: "Image size" }).selectOption("512");
  const { print } = await until(() => canvasState(page, IMAGE), ({ mean }) => mean > 5, "no frame came");
  await page.getByRole("combobox", { name: "Probe" }).selectOption("steered");
  await changed(page, print);
  await page.waitForTimeout(SETTLED_MS);
  await page.screenshot({ path: path.join(PICTURES, "console.png") });
  const { page: tools, first } = await openScan({ browser, service });
  await tools.getByRole("button", { name: "Confidence: show or hide" }).click();
  await tools.getByRole("button", { name: "Image: show or hide" }).click();
  await tools.getByRole("button", { name: "Add a needle" }).click();
  await changed(tools, first.print);
  await tools.waitForTimeout(SETTLED_MS);
  await tools.screenshot({ path: path.join(PICTURES, "console_tools.png") });
  const { page: editing } = await openScan({ browser, service }, { scheme: "dark" });
  for (const panel of ["Confidence", "Image", "Tools", "Pose"]) await editing.getByRole("button", { name: `${panel}: show or hide` }).click();
  await editing.getByRole("button", { name: "Edit: show or hide" }).click();
  await editing.getByRole("button", { name: "+ Insert" }).click();
  await editing.getByRole("combobox", { name: "Tissue" }).selectOption("cyst");
  await editing.waitForTimeout(SETTLED_MS);
  await editing.screenshot({ path: path.join(PICTURES, "console_editing.png") });
  const maps = await openPage({ browser, service }, "#/maps/demo");
  await until(() => canvasState(maps, '[data-testid="map-echo"]'), ({ mean }) => mean > 1, "no map came");
  await maps.waitForTimeout(SETTLED_MS);
  await maps.screenshot({ path: path.join(PICTURES, "console_maps.png") });
} finally {
  await browser.close();
  await service.stop();
}
