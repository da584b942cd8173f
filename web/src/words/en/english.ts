/** The English catalogue, which also says what every other one must have. */

import { compare } from "./compare";
import { connect } from "./connect";
import { jobs } from "./jobs";
import { locate } from "./locate";
import { maps } from "./maps";
import { registrations } from "./registrations";
import { scan } from "./scan";
import { scenes } from "./scenes";
import { session } from "./session";
import { shared } from "./shared";
import { shell } from "./shell";
import { space } from "./space";
import { tools } from "./tools";
import { train } from "./train";

export const english = { compare, connect, jobs, locate, maps, registrations, scan, scenes, session, shared, shell, space, tools, train };

export type Words = typeof english;
