/** What the service says about the fields of its contract: forms, lists and their words are drawn from it. */

/** A JSON schema with its references filled in. */
export interface Described {
  type?: string;
  title?: string;
  description?: string;
  default?: unknown;
  nullable?: boolean;
  minimum?: number;
  exclusiveMinimum?: number;
  maximum?: number;
  enum?: string[];
  const?: string;
  examples?: unknown[];
  properties?: Record<string, Described>;
  items?: Described;
  oneOf?: Described[];
}
