/** What the service says about the fields of its contract: forms, lists and their words are drawn from it. */

/** A JSON schema with its references filled in. */
export interface Described {
  type?: string;
  /** Instead of the words of the name: given where a form is drawn. */
  title?: string;
  description?: string;
  default?: unknown;
  nullable?: boolean;
  minimum?: number;
  exclusiveMinimum?: number;
  maximum?: number;
  minItems?: number;
  maxItems?: number;
  enum?: string[];
  const?: string;
  examples?: unknown[];
  "x-numbers"?: boolean;
  properties?: Record<string, Described>;
  items?: Described;
  oneOf?: Described[];
}

const UNUSUAL: Record<string, string> = { bmode: "B-mode", tgc: "TGC", val: "held-out" };
const UNITS: Record<string, string> = { mm: "mm", deg: "°", db: "dB", mhz: "MHz", s: "s", ms: "ms", gb: "GB" };

/** The name of a field as people read it, and its unit, by which the name ends. */
export function labelOf(name: string): { label: string; unit: string } {
  const words = name.split("_");
  const unit = words.length > 1 ? UNITS[words.at(-1)!] : undefined;
  if (unit !== undefined) words.pop();
  const label = words.map((word) => UNUSUAL[word] ?? word).join(" ");
  return { label: label.charAt(0).toUpperCase() + label.slice(1), unit: unit ?? "" };
}

/** The values that the fields of an object have where none is given. */
export function defaultsOf({ properties = {} }: Described): Record<string, unknown> {
  return Object.fromEntries(Object.entries(properties).map(([name, field]) => [name, field.default]));
}

/** The members of a closed set, by the kind that tells them apart. */
export function membersOf<Kind extends string>({ oneOf = [] }: Described): ReadonlyMap<Kind, Described> {
  return new Map(oneOf.map((one) => [one.properties!.kind!.const as Kind, one]));
}

/** Whether one input is enough for a value. */
export function isSimple({ type, enum: choices }: Described): boolean {
  return choices !== undefined || ["number", "integer", "boolean", "string"].includes(type ?? "");
}

/** Whether a value is a file, which travels within a document. */
export function isFile({ properties = {} }: Described): boolean {
  return "data" in properties && "format" in properties;
}

/** Whether a value is a place, a direction or an extent: three numbers. */
export function isVector({ type, items, minItems, maxItems }: Described): boolean {
  return type === "array" && items?.type === "number" && minItems === 3 && maxItems === 3;
}

/** Whether a value is a list of words, which a person writes with commas between them. */
export function isWordList({ type, items }: Described): boolean {
  return type === "array" && items?.type === "string";
}
