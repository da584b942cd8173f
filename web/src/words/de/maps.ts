/** maps: what it says in German. */

import type { Words } from "../en/english";

export const maps: Words["maps"] = {};
