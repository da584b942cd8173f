/** How the console speaks a language that is not translated whole: what a catalogue lacks is said in English. */

/** Names of what the service has; what is not among them is called as the service calls it. */
export type Named = Readonly<Record<string, string | undefined>>;

/** A catalogue, or a part of it, in which any text may be missing. */
export type Translated<Part> = Part extends string | readonly unknown[] | ((...given: never[]) => unknown)
  ? Part
  : { readonly [Name in keyof Part]?: Translated<Part[Name]> };

/** A catalogue with the texts of another over it. A text in place of a sentence has {0}, {1} … where that is given something. */
export function translated<Part extends object>(before: Part, other: object): Part {
  const entries = Object.entries(other).map(([name, text]: [string, unknown]) => {
    const known: unknown = before[name as keyof Part];
    if (isPart(known) && isPart(text)) return [name, translated(known, text)];
    return [name, typeof known === "function" && typeof text === "string" ? sentenceOf(text) : text];
  });
  return { ...before, ...(Object.fromEntries(entries) as Partial<Part>) };
}

/** Where texts are missing, as "scan.cine.play". */
export function missingIn(english: object, other: object, within = ""): string[] {
  return Object.entries(english).flatMap(([name, text]: [string, unknown]) => {
    const found = (other as Record<string, unknown>)[name];
    if (found === undefined) return [within + name];
    return isPart(text) && isPart(found) ? missingIn(text, found, `${within}${name}.`) : [];
  });
}

function sentenceOf(text: string): (...given: unknown[]) => string {
  return (...given) => text.replace(/\{(\d)\}/g, (_, place) => String(given[Number(place)]));
}

function isPart(value: unknown): value is object {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}
