/** What the service tells of itself and of those who use it: its doors, its people, its workers, its last minutes. */

import { getJson, postJson, type Schemas } from "./client";
import { operations, roles } from "./generated/contract";

export type ServiceInfo = Schemas["ServiceInfo"];

export const serviceInfo = (): Promise<ServiceInfo> => getJson("/v1/service", {});

export type SignInProvider = Schemas["SignInProvider"];

/** null: with keys alone. */
export async function signInProvider(): Promise<SignInProvider | null> {
  return (await getJson("/v1/sign-in", {})).provider;
}

export type Me = Schemas["Me"];
/** Something that the service does, as "POST /v1/jobs". */
export type Operation = keyof typeof operations;

export const whoAmI = (): Promise<Me> => getJson("/v1/me", {});

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

export type Statistics = Schemas["ServiceStatistics"];
export type StageTimes = Schemas["StageTimes"];

export const statistics = (signal: AbortSignal): Promise<Statistics> => getJson("/v1/statistics", {}, { signal });

export type AuditEntry = Schemas["AuditEntry"];

export interface AuditQuery {
  sinceHours: number;
  /** Only of this name; empty: of all. */
  who: string;
  /** Only this operation, or kind of operation; empty: all. */
  what: string;
}

/** The last entries, oldest first. */
export async function auditEntries({ sinceHours, who, what }: AuditQuery, signal: AbortSignal): Promise<AuditEntry[]> {
  const query = { since_hours: String(sinceHours), ...(who && { who }), ...(what && { what }) };
  return (await getJson("/v1/audit", {}, { query, signal })).entries;
}

export type Worker = Schemas["Worker"];
export type WorkerState = Worker["state"];
/** What an admin may want of a worker. */
export type Wish = "pause" | "drain" | "resume";

export async function listWorkers(signal: AbortSignal): Promise<Worker[]> {
  return (await getJson("/v1/workers", {}, { signal })).workers;
}

export function wish(worker: string, wanted: Wish): Promise<Worker> {
  return postJson(`/v1/workers/{worker}:${wanted}`, { worker });
}
