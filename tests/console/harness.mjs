/** A real service with the demo scene on real ports, and Debian's Chromium that looks at it. */

import { spawn } from "node:child_process";
import { copyFileSync, createWriteStream, mkdirSync, mkdtempSync, readFileSync, rmSync } from "node:fs";
import { createRequire } from "node:module";
import { createServer } from "node:net";
import { tmpdir } from "node:os";
import path from "node:path";
import { fileURLToPath } from "node:url";

export const ROOT = path.resolve(path.dirname(fileURLToPath(import.meta.url)), "../..");
const require = createRequire(path.join(ROOT, "web/package.json"));
const { chromium } = require("playwright-core");

export const PYTHON = process.env.ULTRAGRAY_TEST_PYTHON ?? path.join(ROOT, ".venv/bin/python");
export const SOURCES = ["model", "proto", "workers", "service"].map((folder) => path.join(ROOT, folder)).join(":");
const CHROMIUM = process.env.ULTRAGRAY_TEST_CHROMIUM ?? "/usr/bin/chromium";
const CHROMIUM_FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"];
const START_TIMEOUT_MS = 600_000;
export const SCREENSHOTS = path.join(ROOT, "build/console-screenshots");
export const TIMEOUT_MS = 120_000; // of what a page should show: the machine may be busy
export const BACKGROUND_TIMEOUT_MS = 1_800_000; // of jobs and checks of sweeps and scenes: their processes come last on a busy machine

/** A free port, below those that the system gives to connections: the service must come back on the same one. */
function freePort() {
  return new Promise((resolve) => {
    const server = createServer();
    server.on("error", () => resolve(freePort()));
    server.listen(20_000 + Math.floor(12_000 * Math.random()), "127.0.0.1", () => {
      const { port } = server.address();
      server.close(() => resolve(port));
    });
  });
}

/** `python -m ultragray_service` over a data folder with the demo scene as `demo`. */
export class Service {
  /** Starts one; `environment` holds further settings. */
  static async start(environment = {}) {
    const service = new Service();
    service.folder = mkdtempSync(path.join(tmpdir(), "ultragray-console-"));
    service.data = path.join(service.folder, "data");
    mkdirSync(service.data);
    copyFileSync(path.join(ROOT, "model/ultragray/phantom/spine.ugr"), path.join(service.data, "demo.ugr"));
    service.port = await freePort();
    service.url = `http://127.0.0.1:${service.port}`;
    service.environment = environment;
    try {
      await service.up();
    } catch (error) {
      service.process.kill("SIGKILL"); // else it would keep this process from ending
      throw error;
    }
    return service;
  }

  /** Starts the process, on the port that it had before. */
  async up() {
    const settings = {
      ULTRAGRAY_DATA_FOLDER: this.data,
      ULTRAGRAY_HTTP_PORT: String(this.port),
      ULTRAGRAY_GRPC_PORT: "0",
      ULTRAGRAY_PRELOAD: "demo",
      ULTRAGRAY_EMBEDDED_WORKER: "false",
      OMP_NUM_THREADS: "1",
      PYTHONPATH: SOURCES,
      ...this.environment,
    };
    const log = path.join(this.folder, "log");
    this.process = spawn(PYTHON, ["-m", "ultragray_service"], {
      env: { ...process.env, ...settings },
      stdio: ["ignore", "ignore", "pipe"],
    });
    this.process.stderr.pipe(createWriteStream(log, { flags: "a" }));
    const end = Date.now() + START_TIMEOUT_MS;
    while (Date.now() < end) {
      if (this.process.exitCode !== null) throw new Error(`the service ended: ${readFileSync(log, "utf8")}`);
      const ready = await fetch(`${this.url}/v1/health/ready`).then((answer) => answer.ok, () => false);
      if (ready) return;
      await new Promise((resolve) => setTimeout(resolve, 200));
    }
    throw new Error(`the service is not ready after ${START_TIMEOUT_MS / 1000} s: ${readFileSync(log, "utf8")}`);
  }

  /** Stops the process, and waits for its end. */
  async down() {
    if (this.process.exitCode !== null) return;
    const ended = new Promise((resolve) => this.process.once("exit", resolve));
    this.process.kill("SIGTERM");
    await ended;
  }

  async stop() {
    await this.down();
    rmSync(this.folder, { recursive: true, force: true });
  }
}

export function launch(flags = CHROMIUM_FLAGS) {
  return chromium.launch({ executablePath: CHROMIUM, args: flags, timeout: TIMEOUT_MS });
}

/** A Chromium whose pages have WebGPU, and its adapter's name: that of this machine's GPU, else of software. */
export async function launchWithGpu(url) {
  const flags = [...CHROMIUM_FLAGS.filter((flag) => flag !== "--disable-gpu"), "--enable-unsafe-webgpu"];
  for (const kind of ["--enable-features=Vulkan", "--use-webgpu-adapter=swiftshader"]) {
    const browser = await launch([...flags, kind]);
    const page = await browser.newPage();
    await page.goto(url); // only pages of secure origins have WebGPU
    const adapter = await page.evaluate(async () => {
      const info = (await navigator.gpu?.requestAdapter())?.info;
      return info && { name: [info.vendor, info.architecture, info.description].filter(Boolean).join(" "), software: info.isFallbackAdapter };
    });
    await page.close();
    if (adapter) return { browser, adapter };
    await browser.close();
  }
  return {};
}

/** A page that remembers what went wrong in it: `page.faults` (errors, refused sources) and `page.foreign` (requests elsewhere).
 *
 * `init`: what runs in it before its own scripts; `touch`: whether it is worked with fingers.
 */
export async function openPage({ browser, service }, hash, { width = 1280, height = 800, scheme = "light", touch = false, locale = "en-US", init } = {}) {
  const viewed = { viewport: { width, height }, colorScheme: scheme, acceptDownloads: true };
  const context = await browser.newContext({ ...viewed, hasTouch: touch, isMobile: touch, locale });
  await context.grantPermissions(["clipboard-read", "clipboard-write"], { origin: service.url });
  const page = await context.newPage();
  page.setDefaultTimeout(TIMEOUT_MS);
  page.faults = [];
  page.foreign = [];
  if (init !== undefined) await page.addInitScript(init);
  page.on("pageerror", (error) => page.faults.push(error.message));
  page.on("console", (message) => {
    if (message.type() === "error") page.faults.push(`${message.text()} (${message.location().url})`);
  });
  page.on("request", (request) => {
    const { origin, protocol } = new URL(request.url());
    if (protocol !== "blob:" && origin !== service.url) page.foreign.push(request.url());
  });
  await page.goto(`${service.url}/${hash}`);
  return page;
}

/** Writes a picture of the page, light and dark, for people to look at. */
export async function picture(page, name) {
  mkdirSync(SCREENSHOTS, { recursive: true });
  for (const scheme of ["light", "dark"]) {
    await page.emulateMedia({ colorScheme: scheme });
    await laidOut(page);
    await page.screenshot({ path: path.join(SCREENSHOTS, `${name}-${scheme}.png`) });
  }
}

/** Waits until the page has laid itself out for what it knows. */
export function laidOut(page) {
  return page.evaluate(() => new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve))));
}

/** What axe finds that is moderate, serious or critical, one string a finding. */
export async function seriousFindings(page) {
  const source = readFileSync(require.resolve("axe-core/axe.min.js"), "utf8");
  await page.evaluate(source); // not by a script element: the page's policy forbids it
  const { violations } = await page.evaluate(() => globalThis.axe.run());
  return violations
    .filter(({ impact }) => impact !== "minor")
    .map(({ id, nodes }) => `${id}: ${nodes.map((node) => node.target.join(" ")).join(", ")}`);
}

/** The pixels of the first canvas within `selector`: a short fingerprint and their mean. */
export function canvasState(page, selector) {
  return page.locator(`${selector} canvas`).first().evaluate((canvas) => {
    if (canvas.width === 0) return { print: 0, mean: 0 };
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let print = 0;
    let sum = 0;
    for (let i = 0; i < data.length; i += 4) {
      print = (Math.imul(print, 31) + data[i]) | 0;
      sum += data[i];
    }
    return { print, mean: (sum * 4) / data.length, width: canvas.width, height: canvas.height };
  });
}

/** Waits until `read` answers something that `accept` takes, and returns it. */
export async function until(read, accept, what, timeoutMs = TIMEOUT_MS) {
  const end = Date.now() + timeoutMs;
  let last;
  while (Date.now() < end) {
    last = await read();
    if (accept(last)) return last;
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  throw new Error(`${what}; the last was ${JSON.stringify(last)}`);
}

/** Keeps the page's requests to addresses that match from being sent until the function that is returned is called. */
export async function hold(page, addresses) {
  let release;
  const released = new Promise((resolve) => (release = resolve));
  await page.route(addresses, async (route) => {
    await released;
    await route.continue();
  });
  return release;
}

/** Goes to another view by the header, as wide or narrow as the page is. */
export async function goTo(page, view) {
  const menu = page.getByRole("banner").getByRole("button", { name: /^Views:/ });
  const link = page.getByRole("banner").getByRole("link", { name: view, exact: true });
  if (await menu.isVisible()) await menu.click();
  await link.click();
}

/** What has the focus: its label, else its text. */
export function focused(page) {
  return page.evaluate(() => document.activeElement.ariaLabel ?? document.activeElement.textContent.trim());
}
