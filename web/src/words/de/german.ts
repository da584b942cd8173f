/** The German catalogue. A text that it lacks is shown in English. */

import type { Words } from "../en/english";
import type { Translated } from "../translated";
import { scan, session, space, tools } from "./image";
import { compare, maps, shared, shell } from "./page";
import { connect, locate, registrations } from "./programs";
import { jobs, scenes, train } from "./work";

export const german: Translated<Words> = {
  compare, connect, jobs, locate, maps, registrations, scan, scenes, session, shared, shell, space, tools, train,
}; // prettier-ignore
