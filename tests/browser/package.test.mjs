/** The package as npm has it: a fresh project installs it, and its types hold. */

import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import path from "node:path";
import { after, test } from "node:test";

import { ROOT } from "../console/harness.mjs";

const project = mkdtempSync(path.join(tmpdir(), "ultragray-project-"));
after(() => rmSync(project, { recursive: true, force: true }));
const npm = (folder, ...words) => execFileSync("npm", words, { cwd: folder, encoding: "utf8", stdio: ["ignore", "pipe", "pipe"] });
const PROGRAM = `import { Scene, score, type Pose } from "@ultragray/web";
const pose: Pose = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
const scene = await Scene.load("demo.ugr");
const frame = await scene.render(pose, { height: 384, display: { gain_db: 3 } });
export const told: number = score({ probe: scene.info.probe!, target: pose }, [{ time_s: 0, pose }]).path_mm + frame.pixels().length;
`;

test("a fresh project installs the package and is checked against its types", () => {
  const [{ filename, files }] = JSON.parse(npm(path.join(ROOT, "browser"), "pack", "--json", "--pack-destination", project));
  const names = files.map((file) => file.path);
  for (const name of ["dist/index.js", "dist/index.d.ts", "dist/worker.js", "dist/ultragray.wasm", "dist/generated/openapi.d.ts"]) assert.ok(names.includes(name), name);
  writeFileSync(path.join(project, "package.json"), JSON.stringify({ name: "project", private: true, type: "module" }));
  npm(project, "install", "--offline", "--no-audit", "--no-fund", `./${filename}`);
  writeFileSync(path.join(project, "program.ts"), PROGRAM);
  const options = ["--strict", "--noEmit", "--target", "es2022", "--module", "esnext", "--moduleResolution", "bundler", "--lib", "es2022,dom"];
  const check = () => execFileSync(path.join(ROOT, "browser/node_modules/.bin/tsc"), [...options, "program.ts"], { cwd: project, encoding: "utf8" });
  assert.equal(check(), "");
  writeFileSync(path.join(project, "program.ts"), PROGRAM.replace("height: 384", 'height: "tall"'));
  assert.throws(check, ({ stdout }) => /not assignable to type 'number/.test(stdout));
});
