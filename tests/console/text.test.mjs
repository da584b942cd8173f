/** Numbers and times as people read them: web/src/shared/text.ts without a browser. */

import assert from "node:assert/strict";
import { it } from "node:test";

import { built } from "./sources.mjs";

const { bytes, duration, language, nameOfFile } = await built("shared/text", "words/words.svelte");

it("durations carry over from seconds to minutes to hours", () => {
  const written = { 0.4: "0 s", 59.7: "1 min 0 s", 119.7: "2 min 0 s", 3599.7: "1 h 0 min", 7199: "2 h 0 min", 5400: "1 h 30 min" };
  for (const [seconds, text] of Object.entries(written)) assert.equal(duration(Number(seconds)), text);
});

it("sizes are in powers of a thousand", () => {
  assert.deepEqual([0, 999, 1000, 1_540_000, 250e9].map(bytes), ["0 B", "999 B", "1.0 KB", "1.5 MB", "250 GB"]);
  language.current = "de";
  assert.equal(bytes(3_082_616), "3,1 MB");
  language.current = "en";
});

it("names come of file names", () => {
  const files = ["a b.ugr", "sweep.tar.gz", "scan.igs.mha", "..hidden.zip", "Übung-Schädel.ugr", "第三回-foetus.ugr"];
  assert.deepEqual(files.map(nameOfFile), ["a-b", "sweep", "scan", "hidden", "Ubung-Schadel", "foetus"]);
});
