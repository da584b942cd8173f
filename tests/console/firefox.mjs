/** Debian's Firefox, driven over WebDriver BiDi: the standard that an unchanged Firefox speaks. */

import { existsSync } from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";

import { ROOT, TIMEOUT_MS, until } from "./harness.mjs";

const FIREFOX = process.env.ULTRAGRAY_TEST_FIREFOX ?? "/usr/bin/firefox-esr";

/** A font that Firefox's own style sheet for HTML asks for, which the policy of a page keeps out. */
export const OWN_FONT = /^data:font\//;

/** Why these tests cannot run here; null: they can. */
export const missing = existsSync(FIREFOX)
  ? null
  : `Firefox is not at ${FIREFOX}: apt-get install firefox-esr, or name another place in ULTRAGRAY_TEST_FIREFOX`;

export function launchFirefox() {
  const puppeteer = createRequire(path.join(ROOT, "web/package.json"))("puppeteer-core");
  return puppeteer.launch({ browser: "firefox", executablePath: FIREFOX, headless: true, timeout: 120_000, defaultViewport: null });
}

/** Gives the page another size. */
export async function resize(page, { width, height }) {
  // Firefox 140 knows the command for the size, not the one for the orientation that is sent along.
  await page.setViewport({ width, height }).catch(() => undefined);
  await until(() => page.evaluate(() => innerWidth), (now) => now === width, `the page is not ${width} px wide`);
}

/** A page that remembers what went wrong in it (`page.faults`) and what it asked of other places (`page.foreign`). */
export async function openInFirefox({ browser, service }, hash) {
  const page = await browser.newPage();
  page.setDefaultTimeout(TIMEOUT_MS);
  await resize(page, { width: 1280, height: 800 });
  page.faults = [];
  page.foreign = [];
  page.on("pageerror", (error) => page.faults.push(error.message));
  page.on("console", (message) => {
    if (message.type() === "error") page.faults.push(message.text());
  });
  page.on("request", (request) => {
    const { origin, protocol } = new URL(request.url());
    if (OWN_FONT.test(request.url())) return;
    if (protocol !== "blob:" && origin !== service.url) page.foreign.push(request.url());
  });
  await page.goto(`${service.url}/${hash}`);
  await page.evaluate(() => {
    globalThis.refusedSources = [];
    addEventListener("securitypolicyviolation", ({ blockedURI }) => globalThis.refusedSources.push(blockedURI));
  });
  return page;
}

/** A fingerprint of the first canvas within `selector`, and its mean; see `canvasState` of harness.mjs. */
export function stateInFirefox(page, selector) {
  return page.evaluate((found) => {
    const canvas = document.querySelector(`${found} canvas`);
    if (!canvas || canvas.width === 0) return { print: 0, mean: 0 };
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let print = 0;
    let sum = 0;
    for (let i = 0; i < data.length; i += 4) {
      print = (Math.imul(print, 31) + data[i]) | 0;
      sum += data[i];
    }
    return { print, mean: (sum * 4) / data.length };
  }, selector);
}
