/** Who one is, and what that allows. */

import { getJson, type Schemas } from "./client";
import { operations, roles } from "./generated/contract";

export type Me = Schemas["Me"];
/** Something that the service does, as "POST /v1/jobs". */
export type Operation = keyof typeof operations;

export function whoAmI(): Promise<Me> {
  return getJson("/v1/me", {});
}

/** Who may do an operation in place of `me`, in words; null: `me` may. `owner`: of what it is about. */
export function barredFor(me: Me, operation: Operation, owner: string | null): string | null {
  const { role, owned } = operations[operation];
  if (roles.indexOf(me.role) < roles.indexOf(role)) return roles.slice(roles.indexOf(role)).map((one) => `${one}s`).join(" and ");
  if (!owned || me.role === "admin" || me.name === owner) return null;
  return owner === null ? "admins" : `${owner} and admins`;
}
