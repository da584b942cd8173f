/** What a catalogue of another language must be: as much of the English one as somebody has translated. */

/** Names of what the service has; what is not among them is called as the service calls it. */
export type Named = Readonly<Record<string, string | undefined>>;

/** A catalogue, or a part of it, in which any text may be missing. */
export type Translated<Part> = Part extends string | readonly unknown[] | ((...given: never[]) => unknown)
  ? Part
  : { readonly [Name in keyof Part]?: Translated<Part[Name]> };

/** The English catalogue with the texts of another language over it, where there are such. */
export function translated<Part extends object>(english: Part, other: Translated<Part>): Part {
  const entries = Object.entries(other).map(([name, text]) => {
    const before = english[name as keyof Part];
    return [name, isPart(before) && isPart(text) ? translated(before, text) : text];
  });
  return { ...english, ...(Object.fromEntries(entries) as Partial<Part>) };
}

/** Where texts are missing, as "scan.cine.play". */
export function missingIn(english: object, other: object, within = ""): string[] {
  return Object.entries(english).flatMap(([name, text]: [string, unknown]) => {
    const found = (other as Record<string, unknown>)[name];
    if (found === undefined) return [within + name];
    return isPart(text) && isPart(found) ? missingIn(text, found, `${within}${name}.`) : [];
  });
}

function isPart(value: unknown): value is object {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}
