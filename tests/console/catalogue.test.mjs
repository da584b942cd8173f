/** Every text that a person reads stands in web/src/words, so that the console speaks one language at a time. */

import assert from "node:assert/strict";
import { it } from "node:test";

import { textsOutsideTheCatalogues } from "./catalogue.mjs";

it("no component has a text of its own", () => {
  assert.deepEqual(textsOutsideTheCatalogues(), []);
});
