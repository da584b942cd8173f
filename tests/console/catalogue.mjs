/** Texts of the console that stand in its components instead of in web/src/words. */

import { readdirSync, readFileSync } from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";

import { ROOT } from "./harness.mjs";

const SOURCES = path.join(ROOT, "web/src");
/** Attributes that people read or hear. */
const READ = ["alt", "aria-description", "aria-label", "aria-placeholder", "aria-roledescription", "aria-valuetext", "label", "placeholder", "title"];
/** Of our components: properties with words in them. */
const WORDS = [...READ, "description", "hint", "missing", "question", "what", "xLabel", "yLabel"];
/** What is the same in every language: units, symbols, names of metrics and formats. */
const SAME = /^(?:[\d\s\p{P}\p{S}]|mm|cm|N|dB|ms|px|min|PSNR|MS-SSIM|GMS|GMSD|JSON|PNG|DICOM|MP4|WebM|CSV|NumPy|ROS ?2?|TUM|PLUS|curl|Python|gRPC|WebSocket|OpenIGTLink|MPR|UltraG-Ray|[XYZxyzRLAPSIHFLUV])*$/u;

/** "file:line: text" of every text that is written in a template. */
export function textsOutsideTheCatalogues() {
  const { parse } = createRequire(path.join(ROOT, "web/package.json"))("svelte/compiler");
  return readdirSync(SOURCES, { recursive: true })
    .filter((name) => name.endsWith(".svelte"))
    .sort()
    .flatMap((name) => {
      const source = readFileSync(path.join(SOURCES, name), "utf8");
      return [...textsOf(parse(source, { modern: true }).fragment)].map(({ text, start }) => {
        const line = source.slice(0, start).split("\n").length;
        return `web/src/${name}:${line}: ${text.trim().replace(/\s+/g, " ")}`;
      });
    });
}

function* textsOf(node, isCode = false) {
  if (node === null || typeof node !== "object") return;
  if (Array.isArray(node)) {
    for (const one of node) yield* textsOf(one, isCode);
    return;
  }
  if (node.type === "Text" && !isCode) yield* readable(node.data, node.start);
  if (node.type === "Attribute") {
    if (WORDS.includes(node.name)) yield* valueTexts(node.value);
    return;
  }
  if (node.type === "ExpressionTag") {
    yield* literals(node.expression);
    return;
  }
  const skips = node.type === "RegularElement" && ["code", "kbd", "style", "script"].includes(node.name);
  for (const key of ["fragment", "nodes", "attributes", "body", "consequent", "alternate", "fallback", "pending", "then", "catch"])
    yield* textsOf(node[key], isCode || skips);
}

/** Texts of the value of an attribute: written there, or the literals of its expression. */
function* valueTexts(value) {
  for (const part of Array.isArray(value) ? value : [value])
    if (part?.type === "Text") yield* readable(part.data, part.start);
    else if (part?.type === "ExpressionTag") yield* literals(part.expression);
}

/** Literal texts that an expression may come to; not those that it compares with, takes apart or looks up. */
function* literals(node) {
  if (node === null || node === undefined) return;
  if (node.type === "Literal" && typeof node.value === "string") yield* readable(node.value, node.start);
  if (node.type === "TemplateLiteral") {
    for (const part of node.quasis) yield* readable(part.value.cooked, part.start);
    for (const part of node.expressions) yield* literals(part);
  }
  if (node.type === "ConditionalExpression") yield* literals(node.consequent), yield* literals(node.alternate);
  if (node.type === "LogicalExpression") yield* literals(node.left), yield* literals(node.right);
  if (node.type === "BinaryExpression" && node.operator === "+") yield* literals(node.left), yield* literals(node.right);
}

function* readable(text, start) {
  if (!SAME.test(text)) yield { text, start: start + (text.length - text.trimStart().length) };
}
