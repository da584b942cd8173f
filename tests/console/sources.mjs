/** The sources of the console in Node, for tests of what they compute: bundled, the runes of Svelte compiled, without a browser. */

import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";

import { ROOT } from "./harness.mjs";

const require = createRequire(path.join(ROOT, "web/package.json"));
const { build, transformSync } = require("esbuild");
const { compileModule } = require("svelte/compiler");

const runes = {
  name: "runes",
  setup: ({ onLoad }) =>
    onLoad({ filter: /\.svelte\.ts$/ }, ({ path: filename }) => {
      const { code } = transformSync(readFileSync(filename, "utf8"), { loader: "ts", target: "es2022" });
      return { contents: compileModule(code, { filename }).js.code };
    }),
};

globalThis.localStorage ??= { getItem: () => null }; // the language that a browser remembers
globalThis.navigator ??= { languages: ["en"] }; // and those that it was set to

/** What modules of web/src export, by their paths without an ending. */
export function built(...modules) {
  return bundled(modules.map((name) => `export * from "./${name}";`).join("\n"));
}

/** What a module in web/src would export. */
export async function bundled(contents) {
  const stdin = { contents, resolveDir: path.join(ROOT, "web/src"), loader: "ts" };
  const options = { bundle: true, format: "esm", write: false, plugins: [runes], conditions: ["browser"], logLevel: "error" };
  const { outputFiles } = await build({ stdin, ...options });
  return import(`data:text/javascript;base64,${Buffer.from(outputFiles[0].contents).toString("base64")}`);
}
