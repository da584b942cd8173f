/** The house of the console, as web/README.md draws it, and its two small sizes of text. */

import assert from "node:assert/strict";
import { readdirSync, readFileSync } from "node:fs";
import path from "node:path";
import { describe, it } from "node:test";

import { ROOT } from "./harness.mjs";
import { faults } from "./storeys.mjs";

const SOURCES = path.join(ROOT, "web/src");

describe("the sources of the console", () => {
  it("import nothing from above, beside or in a circle, and are read in one sitting each", () => assert.deepEqual(faults(), []));

  it("say what is not said in the size of the page in one of its two small sizes", () => {
    const names = readdirSync(SOURCES, { recursive: true }).filter((name) => /\.(svelte|css)$/.test(name));
    const sized = (name) => readFileSync(path.join(SOURCES, name), "utf8").match(/font-size: (?:9|1[0-2])(?:\.\d+)?px/g) ?? [];
    assert.deepEqual(names.flatMap((name) => sized(name).map((size) => `${name}: ${size}`)), []);
  });
});
