/** Opens the console of a service in Debian's Chromium and ends when a frame is on it: node first_frame.mjs URL PICTURE.
 *
 * Waits for the service first. PICTURE: where the screenshot goes.
 */

import { canvasState, launch, until } from "../console/harness.mjs";

const [url, picture] = process.argv.slice(2);
const WAIT_MS = 600_000; // a first start sets everything up
const POLL_MS = 100;

async function answers() {
  return fetch(url).then((answer) => answer.ok, () => false);
}

const end = Date.now() + WAIT_MS;
while (!(await answers())) {
  if (Date.now() > end) throw new Error(`nobody answers at ${url} after ${WAIT_MS / 1000} s`);
  await new Promise((resolve) => setTimeout(resolve, POLL_MS));
}
const browser = await launch();
try {
  const page = await browser.newPage({ viewport: { width: 1280, height: 800 } });
  await page.goto(url);
  const isFrame = ({ mean }) => mean > 5; // of 255: the canvas is black before
  await until(() => canvasState(page, '[aria-label="Live image"]'), isFrame, "no frame came");
  console.log(Date.now() / 1000);
  await page.screenshot({ path: picture });
} finally {
  await browser.close();
}
