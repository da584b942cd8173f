/** The house of the console, as web/README.md draws it: no import runs up, none to a neighbour, none in a circle. */

import { readdirSync, readFileSync } from "node:fs";
import path from "node:path";

import { ROOT } from "./harness.mjs";

/** From the ground up: a folder of web/src knows those below its own storey, and none beside it. */
const STOREYS = [
  ["api"],
  ["geometry"],
  ["words"],
  ["page"],
  ["shared"],
  ["session"],
  ["space", "tools", "locate", "plan", "labels", "edit", "registrations", "connect", "jobs"],
  ["scan", "maps", "compare", "train", "scenes"],
  ["shell"],
  ["main.ts"],
];
const MOST_LINES = 600; // what is read in one sitting
const SOURCES = path.join(ROOT, "web/src");
const IMPORT = /(?:^\s*(?:import|export)\s(?:[^"';]*?\sfrom\s+)?|\bimport\()"(\.[^"]+)"/gm;

/** What is wrong with the house, one sentence each. */
export function faults() {
  const files = readdirSync(SOURCES, { recursive: true }).filter((name) => /\.(svelte|ts)$/.test(name) && !name.includes("generated"));
  const texts = new Map(files.sort().map((name) => [name, readFileSync(path.join(SOURCES, name), "utf8")]));
  const imports = new Map([...texts].map(([name, text]) => [name, importsOf(name, text, texts)]));
  const long = [...texts].filter(([, text]) => text.trimEnd().split("\n").length > MOST_LINES);
  return [
    ...files.filter((name) => storeyOf(name) < 0).map((name) => `${name} is in no storey`),
    ...[...imports].flatMap(([name, others]) => others.filter((other) => !mayKnow(name, other)).map((other) => `${name} may not import ${other}`)),
    ...circles(imports).map((along) => `in a circle: ${along.join(" > ")}`),
    ...long.map(([name]) => `${name} has more than ${MOST_LINES} lines`),
  ];
}

const folderOf = (name) => name.split(path.sep)[0];
const storeyOf = (name) => STOREYS.findIndex((folders) => folders.includes(folderOf(name)));
const mayKnow = (name, other) => folderOf(name) === folderOf(other) || storeyOf(other) < storeyOf(name);

/** Modules that one imports, those of which it needs the types alone among them. */
function importsOf(name, text, texts) {
  const targets = [...text.matchAll(IMPORT)].map(([, target]) => path.join(path.dirname(name), target));
  return targets.flatMap((target) => [target, `${target}.ts`].filter((one) => texts.has(one)));
}

/** The first circle of imports, as the names along it; none in a sound house. */
function circles(imports) {
  const done = new Set();
  const from = (name, along) => {
    if (along.includes(name)) return [...along.slice(along.indexOf(name)), name];
    if (done.has(name)) return null;
    for (const next of imports.get(name)) {
      const found = from(next, [...along, name]);
      if (found !== null) return found;
    }
    done.add(name);
    return null;
  };
  const found = [...imports.keys()].map((name) => from(name, [])).find((along) => along !== null);
  return found === undefined ? [] : [found];
}
