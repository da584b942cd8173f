/** Values as Python writes them. */

type Given = Record<string, unknown>;

export function keywords(values: Given): string {
  return Object.entries(values).map(([name, value]) => `${name}=${literal(value)}`).join(", ");
}

/** A value as Python writes it. */
export function literal(value: unknown): string {
  if (value === null) return "None";
  if (typeof value === "boolean") return value ? "True" : "False";
  if (Array.isArray(value)) return `[${value.map(literal).join(", ")}]`;
  if (typeof value === "object")
    return `{${Object.entries(value as Given).map(([name, one]) => `${JSON.stringify(name)}: ${literal(one)}`).join(", ")}}`;
  return JSON.stringify(value);
}

export function capital(word: string): string {
  return word.charAt(0).toUpperCase() + word.slice(1);
}
