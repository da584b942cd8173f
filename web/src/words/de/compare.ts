/** compare: what it says in German. */

import type { Words } from "../en/english";

export const compare: Words["compare"] = {};
