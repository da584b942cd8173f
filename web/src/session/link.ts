/** What the address of Scan tells: pose, probe and settings, as far as they differ from what the scene begins with. */

import { explain } from "../api/client";
import { type Described } from "../api/described";
import { exampleProbe, PROBE_KINDS, type Probe } from "../api/probes";
import { settings } from "../api/generated/contract";
import type { Display } from "../api/stream";
import { fromPositionQuaternion, position, quaternion, type Pose, type Quaternion, type Vector } from "../geometry/pose";
import type { Kept } from "../shell/router.svelte";
import { words } from "../words/words.svelte";
import { AS_RENDERED, CONTACTS, DISPLAY, SIZES } from "./image_settings.svelte";
import { BETWEEN, numberWithin, oneOf, readField, written, type ValueReader } from "./link_values";
import type { Session } from "./session.svelte";
import { differingTools, readTools, TOOL_KEYS } from "./tools_link";

const SLICE = settings.properties!.slice_thickness_mm!;
/** What a person sets of the display; the size of a pixel follows from the probe. */
const DISPLAY_FIELDS = Object.entries(DISPLAY.properties!).filter(([name]) => name !== "pixel_mm") as [keyof Display, Described][];
const PROBE_NUMBERS = [...new Set([...PROBE_KINDS.values()].flatMap(numbersOf))];
const KEYS = [
  ...["pose", "probe", "samples", "slice_mm", "contact", "lines", "unsupported"],
  ...TOOL_KEYS,
  ...PROBE_NUMBERS.map((name) => `probe.${name}`),
  ...DISPLAY_FIELDS.map(([name]) => name),
];

/** A pose as a value of an address. */
export function poseValue(pose: Pose): string {
  const numbers = [...position(pose).map((value) => value.toFixed(6)), ...quaternion(pose).map((value) => value.toFixed(9))];
  return numbers.map((text) => String(Number(text))).join(BETWEEN);
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
export function linkOf(session: Session): Record<string, string | null> {
  const { pose, chosenProbe: probe, image } = session;
  const differing = (value: string, usual: string): string | null => (value === usual ? null : value);
  const link: Record<string, string | null> = Object.fromEntries(KEYS.map((key) => [key, null]));
  link.pose = differing(poseValue(pose), poseValue(session.held(session.scene.home)));
  if (probe !== null) {
    const { kind, ...numbers } = probe;
    link.probe = kind;
    for (const [name, value] of Object.entries(numbers)) link[`probe.${name}`] = String(value);
  }
  for (const [name] of DISPLAY_FIELDS) link[name] = differing(written(image.display[name]), written(AS_RENDERED[name]));
  link.samples = image.samples === null ? null : String(image.samples);
  link.slice_mm = image.sliceThickness_mm === null ? null : String(image.sliceThickness_mm);
  link.contact = image.contact;
  link.lines = image.scanConverted ? null : "stored";
  link.unsupported = image.hidesUnsupported ? "black" : null;
  return { ...link, ...differingTools(session.tools) };
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
  const probe = reader.read("probe", readProbe);
  const display = Object.fromEntries(
    DISPLAY_FIELDS.map(([name, field]) => [name, reader.read(name, (text) => readField(field, text)) ?? AS_RENDERED[name]]),
  ) as unknown as Display;
  const pose = reader.read("pose", readPose);
  const samples = reader.read("samples", readSamples);
  const thickness_mm = reader.read("slice_mm", (text) => numberWithin(SLICE, text));
  const contact = reader.read("contact", (text) => oneOf(CONTACTS, text));
  const stored = reader.read("lines", (text) => oneOf(["stored"], text));
  const unsupported = reader.read("unsupported", (text) => oneOf(["black"], text));
  if (probe !== null || session.chosenProbe !== null) await reader.attempt("probe", () => session.chooseProbe(probe));
  session.image.display = { ...AS_RENDERED, ...display };
  session.image.samples = samples;
  session.image.sliceThickness_mm = thickness_mm;
  session.image.contact = contact;
  session.image.scanConverted = stored === null;
  session.image.hidesUnsupported = unsupported !== null;
  session.tools.take(...readTools(reader));
  session.jumpTo(pose ?? session.held(session.scene.home));
  return reader.refused;
}

/** Reads values of an address, and notes those that cannot be used. */
class Reader implements ValueReader {
  refused: string[] = [];
  constructor(private readonly kept: Kept) {}

  /** null where it is not there, or cannot be used. */
  read<T>(key: string, reader: (text: string, kept: Kept) => T): T | null {
    const text = this.kept[key];
    if (text === undefined) return null;
    try {
      return reader(text, this.kept);
    } catch (error) {
      this.#refuse(key, error);
      return null;
    }
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

function readPose(text: string): Pose {
  const numbers = text.split(BETWEEN).map(Number);
  if (numbers.length !== 7 || text.split(BETWEEN).includes("") || !numbers.every(Number.isFinite))
    throw new Error(words.session.link.pose);
  const [x, y, z, ...rest] = numbers as [number, number, number, ...number[]];
  if (Math.abs(Math.hypot(...rest) - 1) > 1e-2) throw new Error(words.session.link.quaternion);
  return fromPositionQuaternion([x, y, z] as Vector, rest as unknown as Quaternion);
}

function readProbe(kind: string, kept: Kept): Probe {
  const described = PROBE_KINDS.get(oneOf([...PROBE_KINDS.keys()], kind))!;
  const given = numbersOf(described)
    .filter((name) => kept[`probe.${name}`] !== undefined)
    .map((name) => [name, numberWithin(described.properties![name]!, kept[`probe.${name}`]!)] as const);
  return { ...exampleProbe(kind, 50), ...Object.fromEntries(given) };
}

function readSamples(text: string): number {
  return Number(oneOf(SIZES.map(String), text));
}

function numbersOf({ properties = {} }: Described): string[] {
  return Object.keys(properties).filter((name) => name !== "kind");
}
