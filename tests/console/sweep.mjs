/** The files that the tests upload. */

import { execFileSync } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import path from "node:path";

import { PYTHON, ROOT, SOURCES } from "./harness.mjs";

/** A folder with sweep.zip, broken.zip, compared.ugr and refined.ugr; `remove` when done. */
export function makeSweep() {
  const folder = mkdtempSync(path.join(tmpdir(), "ultragray-sweep-"));
  execFileSync(PYTHON, [path.join(ROOT, "tests/console/make_sweep.py"), folder], {
    env: { ...process.env, PYTHONPATH: SOURCES, OMP_NUM_THREADS: "1" },
  });
  return {
    sweep: path.join(folder, "sweep.zip"),
    broken: path.join(folder, "broken.zip"),
    compared: path.join(folder, "compared.ugr"),
    refined: path.join(folder, "refined.ugr"),
    remove: () => rmSync(folder, { recursive: true, force: true }),
  };
}

/** Sends a file as the body of a PUT. */
export async function put(service, route, body, type) {
  const answer = await fetch(`${service.url}${route}`, { method: "PUT", body, headers: { "Content-Type": type } });
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}
