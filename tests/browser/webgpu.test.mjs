/** Frames that WebGPU draws, on whatever adapter this machine's Chromium has, and what happens where it has none or loses it. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import path from "node:path";
import { after, before, test } from "node:test";

import { launch, launchWithGpu } from "../console/harness.mjs";
import { check, differences, FRAMES, MOST, openSite } from "./site.mjs";

const NONE = "this machine's Chromium has no WebGPU adapter, not even in software";

let site, plain, browser, adapter;

before(async () => {
  site = await openSite();
  plain = await launch();
  ({ browser, adapter } = await launchWithGpu(site.url));
});

after(async () => {
  await Promise.all([plain?.close(), browser?.close()]);
  site?.close();
});

/** A page in whose worker `script` runs first. */
async function pageWith(script) {
  const page = await browser.newPage();
  const code = readFileSync(path.join(site.folder, "worker.js"), "utf8");
  await page.route("**/worker.js", (route) => route.fulfill({ body: code + script, contentType: "text/javascript" }));
  await page.goto(site.url);
  return page;
}

/** Limits buffers of the adapter in a page's worker to so many bytes. */
const limited = (bytes) => `;for (const name of ["maxStorageBufferBindingSize", "maxBufferSize"])
  Object.defineProperty(GPUSupportedLimits.prototype, name, { get: () => ${bytes} });`;

test("random frames of WebGPU are those of the reference", async (t) => {
  if (!browser) return t.skip(NONE);
  t.diagnostic(`adapter: ${adapter.name}`);
  const framed = await openSite(FRAMES);
  try {
    const page = await browser.newPage();
    await page.goto(framed.url);
    check(await page.evaluate(differences, { MOST, renderer: "webgpu" }));
    await page.close();
  } finally {
    framed.close();
  }
});

test("a lost device costs no frame: WebAssembly draws those on their way, and the next ones", async (t) => {
  if (!browser) return t.skip(NONE);
  const page = await pageWith(`;const request = GPUAdapter.prototype.requestDevice;
    GPUAdapter.prototype.requestDevice = async function (...wanted) { return (globalThis.device = await request.apply(this, wanted)); };`);
  const settings = { height: 40, width: 50, encoding: "float32" };
  const before = await page.evaluate(async (settings) => {
    const { poses } = await (await fetch("page.json")).json();
    globalThis.poses = poses.slice(0, 4);
    globalThis.scene = await (await import("./index.js")).Scene.load("scene.ugz", { renderer: "webgpu" });
    await globalThis.scene.whole;
    globalThis.first = (await scene.render(poses[0], settings)).pixels();
    const name = scene.renderer;
    globalThis.asked = globalThis.poses.map((pose) => scene.render(pose, settings));
    return name;
  }, settings);
  for (const worker of page.workers()) await worker.evaluate(() => globalThis.device?.destroy()); // that of the page's own image has none
  const { most, lengths, name } = await page.evaluate(async (settings) => {
    const frames = await Promise.all(globalThis.asked);
    const again = (await scene.render(globalThis.poses[0], settings)).pixels();
    const most = again.reduce((most, value, at) => Math.max(most, Math.abs(value - globalThis.first[at])), 0);
    return { most, lengths: frames.map((frame) => frame.pixels().length), name: scene.renderer };
  }, settings);
  assert.deepEqual([before, name], ["webgpu", "wasm"]);
  assert.deepEqual(lengths, [2000, 2000, 2000, 2000]);
  assert.ok(most > 0 && most < 1 / 255, `the frames of both renderers differ by ${most}`);
  await page.close();
});

test("without an adapter, or with one in software, WebAssembly draws unless WebGPU is asked for", async (t) => {
  const load = async (renderer) => {
    const { Scene } = await import("./index.js");
    return Scene.load("scene.ugz", { renderer }).then((scene) => scene.whole.then(() => scene.renderer), ({ message }) => message);
  };
  const loaded = async (one, renderer) => {
    const page = await one.newPage();
    await page.goto(site.url);
    const told = await page.evaluate(load, renderer);
    await page.close();
    return told;
  };
  assert.equal(await loaded(plain, "auto"), "wasm");
  assert.equal(await loaded(plain, "webgpu"), "there is no WebGPU adapter");
  assert.equal(await loaded(plain, "opengl"), "renderer must be one of auto, wasm, webgpu, got opengl");
  const page = await plain.newPage();
  await page.goto(site.url);
  const problem = await page.evaluate(() => {
    const probe = document.createElement("ultragray-probe");
    probe.setAttribute("renderer", "webgpu");
    probe.setAttribute("src", "scene.ugz");
    const told = new Promise((resolve) => probe.addEventListener("problem", ({ detail }) => resolve(detail.message)));
    document.body.append(probe);
    return told;
  });
  assert.equal(problem, "there is no WebGPU adapter");
  await page.close();
  if (!browser) return t.skip(NONE);
  assert.equal(await loaded(browser, "auto"), adapter.software ? "wasm" : "webgpu");
  assert.equal(await loaded(browser, "wasm"), "wasm");
});

test("a scene over the limits of the GPU is refused in a sentence, and a frame over them is left to WebAssembly", async (t) => {
  if (!browser) return t.skip(NONE);
  const small = await pageWith(limited(1 << 20));
  const told = await small.evaluate(async () => {
    const { Scene } = await import("./index.js");
    const load = Scene.load("scene.ugz", { renderer: "webgpu" }); // its first part may fit
    return load.then((scene) => scene.whole).catch(({ message }) => message);
  });
  assert.match(told, /^the scene would take \d+ bytes at once, and the GPU gives at most 1048576$/);
  await small.close();
  const page = await pageWith(limited(8 << 20));
  const names = await page.evaluate(async () => {
    const scene = await (await import("./index.js")).Scene.load("scene.ugz", { renderer: "webgpu" });
    await scene.whole;
    const { poses } = await (await fetch("page.json")).json();
    const found = [];
    for (const side of [32, 1024, 32]) {
      const frame = await scene.render(poses[9], { height: side, width: side });
      found.push([scene.renderer, frame.pixels().some((value) => value > 0)]);
    }
    return found;
  });
  assert.deepEqual(names, [["webgpu", true], ["wasm", true], ["webgpu", true]]);
  await page.close();
});
