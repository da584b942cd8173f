/** space: what it says in German. */

import type { Words } from "../en/english";

export const space: Words["space"] = {};
