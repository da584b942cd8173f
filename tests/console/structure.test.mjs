/** How the console's sources hang together: views apart from each other, no circles, small modules. */

import assert from "node:assert/strict";
import { readdirSync, readFileSync } from "node:fs";
import path from "node:path";
import { describe, it } from "node:test";

import { ROOT } from "./harness.mjs";

const SOURCES = path.join(ROOT, "web/src");
const VIEWS = ["scan", "maps", "compare", "train", "scenes"]; // a folder each
const MOST_LINES = { ".svelte": 199, ".ts": 300 };
const IMPORT = /^\s*(?:import|export)\s+(type\s+)?(?:[^"';]*?\sfrom\s+)?"(\.[^"]+)";/gm;

const files = readdirSync(SOURCES, { recursive: true })
  .filter((name) => /\.(svelte|ts)$/.test(name) && !name.startsWith(path.join("api", "generated")))
  .sort();
const texts = new Map(files.map((name) => [name, readFileSync(path.join(SOURCES, name), "utf8")]));

/** Modules that one imports when it is loaded; with `types`, also those of which it needs the types alone. */
function importsOf(name, { types = false } = {}) {
  return [...texts.get(name).matchAll(IMPORT)]
    .filter(([, isType]) => types || isType === undefined)
    .map(([, , target]) => path.join(path.dirname(name), target))
    .flatMap((target) => [target, `${target}.ts`].filter((one) => texts.has(one)));
}

/** The first circle of imports from a module on, as the names along it; null: there is none. */
function circle(name, along = [], done = new Set()) {
  if (along.includes(name)) return [...along.slice(along.indexOf(name)), name];
  if (done.has(name)) return null;
  for (const next of importsOf(name)) {
    const found = circle(next, [...along, name], done);
    if (found !== null) return found;
  }
  done.add(name);
  return null;
}

describe("the sources of the console", () => {
  it("are read by this test: most modules import others", () => {
    assert.ok(files.filter((name) => importsOf(name, { types: true }).length > 0).length > files.length / 2);
  });

  it("have views that do not know each other", () => {
    const viewOf = (name) => VIEWS.find((view) => name.startsWith(`${view}${path.sep}`));
    const known = files
      .filter((name) => viewOf(name) !== undefined)
      .flatMap((name) => importsOf(name, { types: true }).map((other) => [name, other]))
      .filter(([name, other]) => viewOf(other) !== undefined && viewOf(other) !== viewOf(name));
    assert.deepEqual(known, []);
  });

  it("import nothing in a circle", () => {
    const done = new Set();
    for (const name of files) assert.equal(circle(name, [], done)?.join(" > ") ?? null, null);
  });

  it("say what is not said in the size of the page in one of its two small sizes", () => {
    const sized = (name) => [...texts.get(name).matchAll(/font-size: (?:9|1[0-2])(?:\.\d+)?px/g)].map(([size]) => `${name}: ${size}`);
    assert.deepEqual(files.flatMap(sized), []);
  });

  it("are components below 200 lines and modules of at most 300", () => {
    const lines = (name) => texts.get(name).trimEnd().split("\n").length;
    assert.deepEqual(files.filter((name) => lines(name) > MOST_LINES[path.extname(name)]), []);
  });
});
