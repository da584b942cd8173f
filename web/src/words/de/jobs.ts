/** jobs: what it says in German. */

import type { Words } from "../en/english";

export const jobs: Words["jobs"] = {};
