/** Values of an address as text, and back, within the limits of the service. */

import type { Described } from "../api/described";
import { words } from "../words/words.svelte";

/** Between the numbers of a list; it stands in addresses as it is. */
export const BETWEEN = "_";

/** Reads values of an address by key; null where one is not there, or cannot be used. */
export interface ValueReader {
  read<T>(key: string, reader: (text: string) => T): T | null;
}

export function readField(field: Described, text: string): unknown {
  if (field.type === "boolean") return oneOf(["true", "false"], text) === "true";
  if (field.type === "array") return text.split(BETWEEN).map((one) => numberWithin(field.items!, one));
  if (field.enum) return oneOf(field.enum, text);
  return numberWithin(field, text);
}

export function numberWithin({ minimum = -Infinity, maximum = Infinity }: Described, text: string): number {
  const number = Number(text);
  if (text.trim() === "" || !Number.isFinite(number)) throw new Error(words.session.link.number);
  if (number < minimum || number > maximum) throw new Error(words.session.link.within(minimum, maximum));
  return number;
}

export function oneOf<T extends string>(choices: readonly T[], text: string): T {
  if (!isAmong(choices, text)) throw new Error(words.session.link.oneOf(choices));
  return text;
}

function isAmong<T extends string>(choices: readonly T[], text: string): text is T {
  return (choices as readonly string[]).includes(text);
}

export function written(value: unknown): string {
  return Array.isArray(value) ? value.join(BETWEEN) : String(value);
}
