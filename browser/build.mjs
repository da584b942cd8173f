/** Builds dist/, and the files of the exported page in the Python package: types of the contract and of the C interface, the modules, and the renderer in WebAssembly, which Debian's emscripten compiles. */

import { execFileSync } from "node:child_process";
import { copyFileSync, cpSync, mkdirSync, readFileSync, readdirSync, writeFileSync } from "node:fs";
import { fileURLToPath } from "node:url";
import openapiTS, { astToString } from "openapi-typescript";

const here = (path) => fileURLToPath(new URL(path, import.meta.url));
const run = (command, ...words) => execFileSync(command, words, { cwd: here("."), stdio: "inherit" });

mkdirSync(here("src/generated"), { recursive: true });
const document = JSON.parse(readFileSync(here("../web/openapi.json"), "utf8"));
// What has a default may be left out of settings.
writeFileSync(here("src/generated/openapi.ts"), astToString(await openapiTS(document, { defaultNonNullable: false })));
const shader = (name) => `export const ${name} = ${JSON.stringify(readFileSync(here(`src/gpu/${name}.wgsl`), "utf8"))};\n`;
writeFileSync(here("src/generated/shaders.ts"), ["common", "slice", "draw", "finish"].map(shader).join("")); // a page's policy fetches no text

// Of the C interface the functions, whose arguments and results are numbers in WebAssembly, and how many doubles each field of a structure has.
const header = readFileSync(here("../model/library/ultragray.h"), "utf8").replaceAll(/\/\*[^]*?\*\//g, "");
const signatures = [...header.matchAll(/(void )?(ultragray_\w+)\(([^)]*)\);/g)].map(([, result = "number ", name, given]) => {
  const names = given === "void" ? [] : given.split(",").map((argument) => `${/\w+$/.exec(argument)[0]}: number`);
  return `  ${name}(${names.join(", ")}): ${result.trim()};\n`;
});
const structures = [...header.matchAll(/typedef struct ultragray_(\w+) \{([^}]*)\}/g)].map(([, name, fields]) => {
  const sizes = [...fields.matchAll(/(\w+)((?:\[\d+\])*)[,;]/g)].map(([, field, sides]) => `${field}: ${[...sides.matchAll(/\d+/g)].reduce((all, side) => all * side, 1)}`);
  return `export const ${name.toUpperCase()} = { ${sizes.join(", ")} } as const;\n`;
});
writeFileSync(here("src/generated/interface.ts"), `export interface Functions {\n${signatures.join("")}}\n${structures.join("")}`);
run(here("node_modules/.bin/tsc"));

const build = here("../build/browser");
run("emcmake", "cmake", "-S", here(".."), "-B", build, "-DULTRAGRAY_PYTHON=OFF", "-DCMAKE_BUILD_TYPE=Release");
run("cmake", "--build", build, "--parallel", "2");
copyFileSync(`${build}/ultragray.wasm`, here("dist/ultragray.wasm"));

const page = here("../model/ultragray/exchange/page");
mkdirSync(page, { recursive: true });
for (const name of readdirSync(here("page"))) copyFileSync(here(`page/${name}`), `${page}/${name}`);
cpSync(here("dist"), page, { recursive: true, filter: (name) => !name.endsWith(".d.ts") });
