/** The exported page of the demo scene, on demand with random frames as the reference renders them, handed out by Python's http.server. */

import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { once } from "node:events";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import path from "node:path";

import { PYTHON, ROOT, SOURCES } from "../console/harness.mjs";

export const FRAMES = Number(process.env.ULTRAGRAY_BROWSER_FRAMES ?? 60); // of the tests that compare them
const SEED = 7;
export const MOST = 5e-4; // of a value's difference from the reference
// Where a Gaussian just reaches so much for one of the two, as with the native kernels; and where a point that speckle is
// drawn from lies just in one of its cells for one, in the next for the other: a millionth of a mm moves it there.
const MOST_AT_THRESHOLDS = { off: 1 / 255, natural: 0.1 };
const MOST_FLIPS = 1e-4; // share of such values

/** `frames`: how many random ones the site holds; the reference takes seconds for each. */
export async function openSite(frames = 0) {
  const root = mkdtempSync(path.join(tmpdir(), "ultragray-page-"));
  const folder = path.join(root, "page");
  execFileSync(PYTHON, [path.join(ROOT, "tests/browser/make_frames.py"), folder, String(frames), String(SEED)], {
    env: { ...process.env, PYTHONPATH: SOURCES, OMP_NUM_THREADS: "1" },
    stdio: ["ignore", "inherit", "inherit"],
  });
  const server = spawn(PYTHON, ["-u", "-m", "http.server", "--bind", "127.0.0.1", "--directory", folder, "0"], { stdio: ["ignore", "pipe", "ignore"] });
  const [line] = await once(server.stdout, "data");
  const close = () => {
    server.kill();
    rmSync(root, { recursive: true, force: true });
  };
  return { folder, url: /http:\/\/[^/]+\//.exec(String(line))[0], close };
}

/** Renders all requests in a page, and compares the values, before display settings enlarge a difference. */
export async function differences({ MOST, renderer }) {
  const { Scene } = await import("./index.js");
  const [requests, expected] = await Promise.all([
    fetch("requests.json").then((answer) => answer.json()),
    fetch("expected.bin").then((answer) => answer.arrayBuffer()),
  ]);
  const scenes = {};
  for (const name of new Set(requests.map(({ scene }) => scene))) await (scenes[name] = await Scene.load(name, { renderer })).whole;
  let [at, values, flips, frames] = [0, 0, 0, 0];
  const largest = { off: 0, natural: 0 };
  for (const { scene, pose, settings, enlarged } of requests) {
    const frame = await scenes[scene].render(pose, settings);
    frames += scenes[scene].renderer === renderer || settings.contact === "pressure"; // tissue that gives way is drawn by WebAssembly
    const kind = settings.speckle ?? "off";
    for (const output of frame.info.outputs) {
      const pixels = frame.pixels(output);
      const wanted = new Float32Array(expected, at, pixels.length);
      at += 4 * pixels.length;
      values += pixels.length;
      for (let k = 0; k < pixels.length; k++) {
        const apart = Math.abs(pixels[k] - wanted[k]) / enlarged;
        flips += apart > MOST;
        largest[kind] = Math.max(largest[kind], apart);
      }
    }
  }
  for (const scene of Object.values(scenes)) scene.close();
  return { frames, values, flips, largest, left: expected.byteLength - at };
}

export function check({ frames, values, flips, largest, left }) {
  assert.equal(left, 0);
  assert.equal(frames, FRAMES);
  assert.ok(flips <= MOST_FLIPS * values, `${flips} of ${values} values differ by more than ${MOST}`);
  for (const [speckle, most] of Object.entries(MOST_AT_THRESHOLDS)) assert.ok(largest[speckle] <= most, `speckle ${speckle}: a value differs by ${largest[speckle]}`);
}
