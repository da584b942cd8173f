/** What the address of Scan tells: pose, probe, settings and tools, as far as they differ from what the scene begins with.
 *
 * Which settings there are, and within which limits their values are taken, follows from the contract of the service. Tools are
 * numbered: tool1=needle, tool1.tip_mm=8_0_30.
 */

import { explain } from "../api/client";
import {
  AS_RENDERED, AS_TRAINED, DISPLAY, type Display, exampleProbe, exampleTool, MOST_TOOLS, PLAIN_SETTINGS,
  type PlainSettings, type Probe, PROBE_KINDS, type Tool, TOOL_KINDS, toolField, type ToolKind,
} from "../api/contract";
import type { Described } from "../api/described";
import { fromPositionQuaternion, type Pose, position, quaternion, type Quaternion, type Vector } from "../geometry/pose";
import type { Kept } from "../page/router.svelte";
import { words } from "../words/words.svelte";
import { type Session, SIZES } from "./session.svelte";

type Link = Record<string, string | null>;

/** Between the numbers of a list; it stands in addresses as it is. */
const BETWEEN = "_";
const ADDRESS_NAMES: Record<string, string> = { slice_thickness_mm: "slice_mm" };
/** What a person sets of the display; the size of a pixel follows from the probe. */
const DISPLAY_FIELDS = fieldsOf(DISPLAY, "pixel_mm") as [keyof Display, Described][];
const PLAIN_FIELDS = Object.entries(PLAIN_SETTINGS) as [keyof PlainSettings, Described][];
const PROBE_NUMBERS = [...new Set([...PROBE_KINDS.values()].flatMap((kind) => fieldsOf(kind).map(([name]) => name)))];
const TOOL_FIELDS = new Map([...TOOL_KINDS].map(([kind, described]) => [kind, fieldsOf(described).map(([name]) => name)]));
const TOOLS = Array.from({ length: MOST_TOOLS }, (_, index) => `tool${index + 1}`);
const KEYS = [
  ...["pose", "probe", "samples", "lines", "unsupported"],
  ...PLAIN_FIELDS.map(([name]) => keyOf(name)),
  ...PROBE_NUMBERS.map((name) => `probe.${name}`),
  ...DISPLAY_FIELDS.map(([name]) => name),
  ...TOOLS.flatMap((tool) => [tool, ...new Set([...TOOL_FIELDS.values()].flat().map((name) => `${tool}.${name}`))]),
];

/** A pose as a value of an address. */
export function poseValue(pose: Pose): string {
  return joined(position(pose), 6) + BETWEEN + joined(quaternion(pose), 9);
}

/** Numbers as a value of an address. */
export function joined(numbers: readonly number[], digits: number): string {
  return numbers.map((value) => String(Number(value.toFixed(digits)))).join(BETWEEN);
}

/** The numbers of such a value; null where they are not so many. */
export function numbersIn(text: string, count: number): number[] | null {
  const parts = text.split(BETWEEN);
  const numbers = parts.map(Number);
  return parts.length === count && !parts.includes("") && numbers.every(Number.isFinite) ? numbers : null;
}

/** The pose that a value of an address tells; null where it tells none. */
export function poseOrNull(text: string | undefined): Pose | null {
  try {
    return text === undefined ? null : readPose(text);
  } catch {
    return null;
  }
}

/** The values of a session by key; null: as the scene begins. */
export function linkOf(session: Session): Link {
  const { pose, chosenProbe: probe, image } = session;
  const differing = (value: string, usual: string): string | null => (value === usual ? null : value);
  const link: Link = Object.fromEntries(KEYS.map((key) => [key, null]));
  link.pose = differing(poseValue(pose), poseValue(session.held(session.scene.home)));
  if (probe !== null) {
    const { kind, ...numbers } = probe;
    link.probe = kind;
    for (const [name, value] of Object.entries(numbers)) link[`probe.${name}`] = String(value);
  }
  for (const [name] of DISPLAY_FIELDS) link[name] = differing(written(image.display[name]), written(AS_RENDERED[name]));
  for (const [name] of PLAIN_FIELDS) link[keyOf(name)] = differing(written(image.plain[name]), written(AS_TRAINED[name]));
  link.samples = image.samples === null ? null : String(image.samples);
  link.lines = image.scanConverted ? null : "stored";
  link.unsupported = image.hidesUnsupported ? "black" : null;
  for (const [index, tool] of session.tools.all.entries()) Object.assign(link, toolLink(TOOLS[index]!, tool));
  return link;
}

/** Whether an address tells anything of that. */
export function isLink(kept: Kept): boolean {
  return KEYS.some((key) => key in kept);
}

/** Whether a session is as an address tells it. */
export function isAsLinked(session: Session, kept: Kept): boolean {
  return Object.entries(linkOf(session)).every(([key, value]) => (kept[key] ?? null) === value);
}

/** Brings a session to what an address tells; answers with what of it cannot be used, in words. */
export async function followLink(session: Session, kept: Kept): Promise<string[]> {
  const reader = new Reader(kept);
  const { image } = session;
  const probe = reader.read("probe", (kind) => readProbe(kind, kept));
  const display = reader.fields(DISPLAY_FIELDS, AS_RENDERED);
  const plain = reader.fields(PLAIN_FIELDS, AS_TRAINED);
  const pose = reader.read("pose", readPose);
  const samples = reader.read("samples", (text) => Number(oneOf(SIZES.map(String), text)));
  const stored = reader.read("lines", (text) => oneOf(["stored"], text));
  const unsupported = reader.read("unsupported", (text) => oneOf(["black"], text));
  if (probe !== null || session.chosenProbe !== null) await reader.attempt("probe", () => session.chooseProbe(probe));
  [image.display, image.plain, image.samples] = [display, plain, samples];
  [image.scanConverted, image.hidesUnsupported] = [stored === null, unsupported !== null];
  session.tools.take(TOOLS.flatMap((tool) => readTool(reader, tool)));
  session.jumpTo(pose ?? session.held(session.scene.home));
  return reader.refused;
}

/** Reads values of an address, and notes those that cannot be used. */
class Reader {
  refused: string[] = [];
  constructor(private readonly kept: Kept) {}

  /** null where it is not there, or cannot be used. */
  read<T>(key: string, reader: (text: string) => T): T | null {
    const text = this.kept[key];
    if (text === undefined) return null;
    try {
      return reader(text);
    } catch (error) {
      this.#refuse(key, error);
      return null;
    }
  }

  /** All fields of something, those that are not told as `usual` has them. */
  fields<T extends object>(fields: readonly [keyof T & string, Described][], usual: T): T {
    const given = fields.map(([name, field]) => [name, this.read(keyOf(name), (text) => readField(field, text)) ?? usual[name]]);
    return { ...usual, ...(Object.fromEntries(given) as Partial<T>) };
  }

  async attempt(key: string, change: () => Promise<void>): Promise<void> {
    try {
      await change();
    } catch (error) {
      this.#refuse(key, error);
    }
  }

  #refuse(key: string, error: unknown): void {
    this.refused.push(`${key}=${this.kept[key] ?? ""} (${explain(error)})`);
  }
}

/** The fields of a described object; members of a family have their kind among them, which is not asked for. */
function fieldsOf({ properties = {} }: Described, ...without: string[]): [string, Described][] {
  return Object.entries(properties).filter(([name]) => name !== "kind" && !without.includes(name));
}

function keyOf(name: string): string {
  return ADDRESS_NAMES[name] ?? name;
}

function toolLink(key: string, tool: Tool): Link {
  const usual = exampleTool(tool.kind);
  const differing = TOOL_FIELDS.get(tool.kind)!.filter((name) => written(valueOf(tool, name)) !== written(valueOf(usual, name)));
  return { [key]: tool.kind, ...Object.fromEntries(differing.map((name) => [`${key}.${name}`, written(valueOf(tool, name))])) };
}

/** The tool of a key as a list; empty: there is none. */
function readTool(reader: Reader, key: string): Tool[] {
  const kind = reader.read(key, (text) => oneOf([...TOOL_KINDS.keys()], text)) as ToolKind | null;
  if (kind === null) return [];
  const usual = exampleTool(kind);
  const given = TOOL_FIELDS.get(kind)!.map((name) => {
    const before = valueOf(usual, name);
    return [name, reader.read(`${key}.${name}`, (text) => sameLength(readField(toolField(kind, name), text), before)) ?? before];
  });
  return [{ ...usual, ...(Object.fromEntries(given) as Partial<Tool>) } as Tool];
}

function valueOf(tool: Tool, name: string): unknown {
  return tool[name as keyof Tool];
}

/** The value, unless it is a list of another length than the usual one. */
function sameLength(value: unknown, usual: unknown): unknown {
  if (Array.isArray(value) && Array.isArray(usual) && value.length !== usual.length)
    throw new Error(words.session.link.count(usual.length));
  return value;
}

function readPose(text: string): Pose {
  const numbers = numbersIn(text, 7);
  if (numbers === null) throw new Error(words.session.link.pose);
  const [x, y, z, ...rest] = numbers as [number, number, number, ...number[]];
  if (Math.abs(Math.hypot(...rest) - 1) > 1e-2) throw new Error(words.session.link.quaternion);
  return fromPositionQuaternion([x, y, z] as Vector, rest as unknown as Quaternion);
}

function readProbe(kind: string, kept: Kept): Probe {
  const described = PROBE_KINDS.get(oneOf([...PROBE_KINDS.keys()], kind))!;
  const given = fieldsOf(described)
    .filter(([name]) => kept[`probe.${name}`] !== undefined)
    .map(([name, field]) => [name, numberWithin(field, kept[`probe.${name}`]!)]);
  return { ...exampleProbe(kind, 50), ...Object.fromEntries(given) };
}

function readField(field: Described, text: string): unknown {
  if (field.type === "boolean") return oneOf(["true", "false"], text) === "true";
  if (field.type === "object") return objectOf(field, text);
  if (field.type === "array") return text.split(BETWEEN).map((one) => numberWithin(field.items!, one));
  return field.enum ? oneOf(field.enum, text) : numberWithin(field, text);
}

/** An object whose fields are numbers, in their order. */
function objectOf(field: Described, text: string): Record<string, number> {
  const fields = fieldsOf(field);
  const numbers = numbersIn(text, fields.length);
  if (numbers === null) throw new Error(words.session.link.count(fields.length));
  return Object.fromEntries(fields.map(([name, one], index) => [name, numberWithin(one, String(numbers[index]))]));
}

function numberWithin({ minimum = -Infinity, maximum = Infinity }: Described, text: string): number {
  const number = Number(text);
  if (text.trim() === "" || !Number.isFinite(number)) throw new Error(words.session.link.number);
  if (number < minimum || number > maximum) throw new Error(words.session.link.within(minimum, maximum));
  return number;
}

function oneOf<T extends string>(choices: readonly T[], text: string): T {
  const found = choices.find((choice) => choice === text);
  if (found === undefined) throw new Error(words.session.link.oneOf(choices));
  return found;
}

function written(value: unknown): string {
  return typeof value === "object" && value !== null ? Object.values(value).join(BETWEEN) : String(value);
}
