/** Numbers and times in the language of the person, and what is typed as names with values. */

import { language, words } from "../words/words.svelte";

export function count(value: number): string {
  return value.toLocaleString(language.current);
}

const formats = new Map<string, Intl.NumberFormat>(); // making one takes longer than using it

/** With so many digits after the point. */
export function fixed(value: number, digits: number): string {
  const key = `${language.current} ${digits}`;
  let format = formats.get(key);
  if (format === undefined) {
    format = new Intl.NumberFormat(language.current, { minimumFractionDigits: digits, maximumFractionDigits: digits, useGrouping: false });
    formats.set(key, format);
  }
  return format.format(value);
}

/** A number as a person types it, with a point or a comma; NaN: it is none. */
export function numberOf(text: string): number {
  return text.trim() === "" ? NaN : Number(text.trim().replace("−", "-").replace(",", "."));
}

export function localTime(iso: string): string {
  return new Date(iso).toLocaleString(language.current, { dateStyle: "short", timeStyle: "medium" });
}

/** `name = value` a line, the values as JSON, or as text where they are none. Throws an Error in words. */
export function namedValues(lines: string): Record<string, unknown> {
  const values: Record<string, unknown> = {};
  for (const line of lines.split("\n").filter((one) => one.trim() !== "")) {
    const [name = "", ...value] = line.split("=");
    if (value.length === 0) throw new Error(words.shared.nameValue(line.trim()));
    values[name.trim()] = readValue(value.join("=").trim());
  }
  return values;
}

function readValue(text: string): unknown {
  try {
    return JSON.parse(text) as unknown;
  } catch {
    return text;
  }
}
