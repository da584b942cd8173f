/** The tools of a session in an address: tool1=needle, tool1.tip_mm=8_0_30 and so on, as far as they differ from the usual. */

import { exampleTool, GHOST, MOST_TOOLS, TOOL_KINDS, toolField, type Tool, type ToolKind } from "../api/tools";
import { words } from "../words/words.svelte";
import { numberWithin, oneOf, readField, written, type ValueReader } from "./link_values";
import type { Tools } from "./tools.svelte";

const GHOST_KEY = "ghost";
const KINDS = [...TOOL_KINDS.keys()];
const FIELDS = new Map(KINDS.map((kind) => [kind, Object.keys(TOOL_KINDS.get(kind)!.properties!).filter((name) => name !== "kind")]));
const PLACES = Array.from({ length: MOST_TOOLS }, (_, index) => `tool${index + 1}`);

export const TOOL_KEYS: readonly string[] = [
  GHOST_KEY,
  ...PLACES.flatMap((place) => [place, ...new Set([...FIELDS.values()].flat().map((name) => `${place}.${name}`))]),
];

/** The values by key; null: as a session begins. */
export function differingTools({ all, ghost }: Tools): Record<string, string | null> {
  const link: Record<string, string | null> = Object.fromEntries(TOOL_KEYS.map((key) => [key, null]));
  if (ghost > 0) link[GHOST_KEY] = String(ghost);
  for (const [index, tool] of all.entries()) {
    const place = PLACES[index]!;
    const usual = exampleTool(tool.kind);
    link[place] = tool.kind;
    for (const name of FIELDS.get(tool.kind)!) {
      const value = written(valueOf(tool, name));
      if (value !== written(valueOf(usual, name))) link[`${place}.${name}`] = value;
    }
  }
  return link;
}

/** The tools and the ghost that an address tells. */
export function readTools(reader: ValueReader): [Tool[], number] {
  const tools = PLACES.flatMap((place) => {
    const kind = reader.read(place, (text) => oneOf(KINDS, text));
    return kind === null ? [] : [readTool(reader, place, kind)];
  });
  return [tools, reader.read(GHOST_KEY, (text) => numberWithin(GHOST, text)) ?? 0];
}

function readTool(reader: ValueReader, place: string, kind: ToolKind): Tool {
  const usual = exampleTool(kind);
  const given = FIELDS.get(kind)!.map((name) => {
    const before = valueOf(usual, name);
    return [name, reader.read(`${place}.${name}`, (text) => sameLength(readField(toolField(kind, name), text), before)) ?? before];
  });
  return { ...usual, ...Object.fromEntries(given) } as Tool;
}

/** The value, unless it is a list of another length than the usual one. */
function sameLength(value: unknown, usual: unknown): unknown {
  if (Array.isArray(value) && Array.isArray(usual) && value.length !== usual.length)
    throw new Error(words.session.link.count(usual.length));
  return value;
}

function valueOf(tool: Tool, name: string): unknown {
  return tool[name as keyof Tool];
}
