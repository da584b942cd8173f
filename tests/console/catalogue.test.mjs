/** Every text that a person reads stands in web/src/words; a language but English may lack some. */

import assert from "node:assert/strict";
import { it } from "node:test";

import { textsOutsideTheCatalogues } from "./catalogue.mjs";
import { bundled } from "./sources.mjs";

const { english, german, missingIn, translated } = await bundled(`export { english } from "./words/en/english";
  export { german } from "./words/de/german"; export { missingIn, translated } from "./words/translated";`);

it("no component has a text of its own", () => {
  assert.deepEqual(textsOutsideTheCatalogues(), []);
});

it("what a language lacks is said in English", (test) => {
  const whole = { cine: { play: "Play", next: "Next" }, close: "Close", of: (name) => `of ${name}` };
  const mixed = translated(whole, { cine: { play: "Abspielen" }, of: "von {0}" });
  assert.deepEqual([mixed.cine, mixed.close, mixed.of("x")], [{ play: "Abspielen", next: "Next" }, "Close", "von x"]);
  assert.deepEqual(missingIn(whole, { cine: { play: "Abspielen" } }), ["cine.next", "close", "of"]);
  test.diagnostic(`missing in German: ${missingIn(english, german).join(", ") || "nothing"}`);
});
