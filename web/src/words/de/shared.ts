/** shared: what it says in German. */

import type { Words } from "../en/english";

export const shared: Words["shared"] = {};
