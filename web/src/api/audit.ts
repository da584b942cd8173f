/** Who did what. */

import { getJson, type Schemas } from "./client";

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
