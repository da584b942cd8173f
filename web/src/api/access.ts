/** Who one is, and what that allows. */

import { getJson, type Schemas } from "./client";
import { operations, roles } from "./generated/contract";

export type Me = Schemas["Me"];
/** Something that the service does, as "POST /v1/jobs". */
export type Operation = keyof typeof operations;

export function whoAmI(): Promise<Me> {
  return getJson("/v1/me", {});
}

/** Those who may do something. */
export interface Allowed {
  owner: string | null;
  roles: readonly Me["role"][];
}

/** Who may do an operation in place of `me`; null: `me` may. `owner`: of what it is about. */
export function barredFor(me: Me, operation: Operation, owner: string | null): Allowed | null {
  const { role, owned } = operations[operation];
  if (roles.indexOf(me.role) < roles.indexOf(role)) return { owner: null, roles: roles.slice(roles.indexOf(role)) };
  if (!owned || me.role === "admin" || me.name === owner) return null;
  return { owner, roles: ["admin"] };
}
