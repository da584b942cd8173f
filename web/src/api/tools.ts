/** Tools in the image: needles and the like, as the service describes them. */

import { defaultsOf, type Described } from "./described";
import { settings } from "./generated/contract";
import type { StreamSettings } from "./stream";

export type Tool = NonNullable<StreamSettings["tools"]>[number];
export type ToolKind = Tool["kind"];
export type ToolFrame = Tool["frame"];

/** What a tool of each kind is made of. */
export const TOOL_KINDS: ReadonlyMap<ToolKind, Described> = new Map(
  settings.properties!.tools!.items!.oneOf!.map((one) => [one.properties!.kind!.const as ToolKind, one]),
);
/** Of one frame. */
export const MOST_TOOLS = settings.properties!.tools!.maxItems!;
export const GHOST = settings.properties!.ghost!;
export const TOOL_FRAMES = TOOL_KINDS.get("needle")!.properties!.frame!.enum as ToolFrame[];

/** What is said of one field of a tool. */
export function toolField(kind: ToolKind, name: string): Described {
  return TOOL_KINDS.get(kind)!.properties![name]!;
}

/** A tool of that kind as the service knows one, with everything that it takes for granted. */
export function exampleTool(kind: ToolKind): Tool {
  const described = TOOL_KINDS.get(kind)!;
  return { ...defaultsOf(described), ...(described.examples![0] as Tool) };
}

/** The tool without the fields that are as the service takes them for granted. */
export function differingFields(tool: Tool): Pick<Tool, "kind"> & Record<string, unknown> {
  const usual = defaultsOf(TOOL_KINDS.get(tool.kind)!);
  const differing = Object.entries(tool).filter(([name, value]) => JSON.stringify(value) !== JSON.stringify(usual[name]));
  return { ...Object.fromEntries(differing), kind: tool.kind };
}
