/** Measures frames that Debian's Chromium renders itself beside those of the native kernels with 128-bit vectors.
 *
 * node tests/browser/measure.mjs [SECONDS]: after the timings it renders for so long, to see memory grow (default 600).
 * Prints JSON.
 */

import { execFileSync, spawn } from "node:child_process";
import { once } from "node:events";
import { mkdtempSync, readdirSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import path from "node:path";
import { gzipSync } from "node:zlib";

import { launch, launchWithGpu, PYTHON, ROOT, SOURCES } from "../console/harness.mjs";
import { Memory, watchRenderer } from "./memory.mjs";

const SIZES = [512, 384];
const FRAMES = 60; // of each size
const WORKERS = 2; // beside one
const ROUNDS = 3; // of browser and native kernels in turn
const SAMPLE_S = 10;
const seconds = Number(process.argv[2] ?? 600);
const folder = mkdtempSync(path.join(tmpdir(), "ultragray-measure-"));
const site = path.join(folder, "page");
const environment = { ...process.env, PYTHONPATH: SOURCES, OMP_NUM_THREADS: "1" };
const python = (...words) => execFileSync(PYTHON, words, { env: environment, encoding: "utf8", stdio: ["ignore", "pipe", "inherit"] });

const rounded = (value) => Math.round(value * 100) / 100;
const median = (values) => [...values].sort((a, b) => a - b)[values.length >> 1];

/** Milliseconds of each frame along the sweep, one after another. */
async function rendered_ms({ side, frames, renderer = "wasm", workers = 1, before = 5 }) {
  const { poses } = await (await fetch("page.json")).json();
  const scene = ((globalThis.scenes ??= [])[workers] ??= await (await import("./index.js")).Scene.load("scene.ugz", { renderer, workers }));
  await scene.whole;
  const found = [];
  for (let k = -before; k < frames; k++) {
    if (k === 0 && scene.workers < workers) k = -before; // they still start
    const begin = performance.now();
    await scene.render(poses[(k + before) % poses.length], { height: side, width: side });
    if (k >= 0) found.push(performance.now() - begin);
  }
  return found;
}

python(path.join(ROOT, "tests/browser/make_frames.py"), site, "0", "0");
const server = spawn(PYTHON, ["-u", "-m", "http.server", "--bind", "127.0.0.1", "--directory", site, "0"], { stdio: ["ignore", "pipe", "ignore"] });
const [line] = await once(server.stdout, "data");
const url = /http:\/\/[^/]+\//.exec(String(line))[0];
const browser = await launch();
try {
  const cold = await browser.newPage();
  await cold.goto(url);
  const first_ms = await cold.evaluate(
    () =>
      new Promise((resolve) => {
        const tell = () => resolve(performance.now());
        if (/pixels/.test(document.querySelector("#status").value)) tell();
        else document.querySelector("ultragray-probe").addEventListener("frame", tell, { once: true });
      }),
  );
  await cold.close();
  const page = await browser.newPage();
  watchRenderer(site);
  await page.goto(url);
  const times = Object.fromEntries(SIZES.map((side) => [side, { browser: [], together: [], native: [] }]));
  for (let round = 0; round < ROUNDS; round++) {
    for (const side of SIZES) {
      times[side].browser.push(...(await page.evaluate(rendered_ms, { side, frames: FRAMES })));
      times[side].together.push(...(await page.evaluate(rendered_ms, { side, frames: FRAMES, workers: WORKERS })));
      times[side].native.push(...JSON.parse(python(path.join(ROOT, "tests/browser/measure_native.py"), String(side), String(FRAMES))));
    }
  }
  const sizes = SIZES.map((side) => {
    const [here, together, native] = [times[side].browser, times[side].together, times[side].native].map(median);
    const of_workers = { workers: WORKERS, together_ms: rounded(together), faster: rounded(here / together) };
    return { side, browser_ms: rounded(here), native_ms: rounded(native), ratio: rounded(here / native), frames_per_s: rounded(1000 / here), ...of_workers };
  });
  const gpu = await launchWithGpu(url);
  let webgpu;
  if (gpu.browser) {
    const { name, software } = gpu.adapter;
    const drawing = await gpu.browser.newPage();
    await drawing.goto(url);
    const [side] = SIZES;
    const ms = median(await drawing.evaluate(rendered_ms, { side, renderer: "webgpu", ...(software ? { frames: 3, before: 1 } : { frames: FRAMES }) }));
    webgpu = { adapter: software ? `${name}, in software` : name, side, ms: rounded(ms), frames_per_s: rounded(1000 / ms) };
    await gpu.browser.close();
  }
  await page.evaluate(rendered_ms, { side: 256, frames: 300, workers: WORKERS });
  const memory = await Memory.of(browser, page);
  const sampled = async () => ({ held: await memory.held(), renderer: await memory.renderer(), resident: await memory.resident() });
  const samples = [await sampled()];
  for (let passed = 0; passed < seconds; passed += SAMPLE_S) {
    await page.evaluate(rendered_ms, { side: 256, frames: SAMPLE_S * 30, workers: WORKERS });
    samples.push(await sampled());
  }
  const residents = samples.map(({ resident }) => rounded(resident));
  const files = readdirSync(site, { recursive: true }).filter((name) => /\.(js|wasm|html|css)$/.test(name));
  const figures = {
    measured: JSON.parse(python("-m", "ultragray_studies.bench.report")),
    sizes,
    ...(webgpu && { webgpu }),
    first_frame_ms: rounded(first_ms),
    frames_for_growth: Math.ceil(seconds / SAMPLE_S) * SAMPLE_S * 30,
    memory_mib: { first: residents[0], last: residents.at(-1), most: Math.max(...residents) },
    renderer_mib: { first: rounded(samples[0].renderer), last: rounded(samples.at(-1).renderer) },
    held_mib: { first: rounded(samples[0].held), last: rounded(samples.at(-1).held) },
    page_gzip_kb: rounded(files.reduce((sum, name) => sum + gzipSync(readFileSync(path.join(site, name))).length, 0) / 1000),
  };
  process.stdout.write(`${JSON.stringify(figures, null, 2)}\n`);
} finally {
  await browser.close();
  server.kill();
  rmSync(folder, { recursive: true, force: true });
}
