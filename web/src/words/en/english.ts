/** The English catalogue, which has every text of the console. */

import { scan, session, space, tools } from "./image";
import { compare, maps, shared, shell } from "./page";
import { connect, labels, locate, registrations } from "./programs";
import { jobs, scenes, train } from "./work";

export const english = { compare, connect, jobs, labels, locate, maps, registrations, scan, scenes, session, shared, shell, space, tools, train };

export type Words = typeof english;
