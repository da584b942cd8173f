/** The settings of frames as the contract of the service describes them: outputs, probes, tools, and all that is set by one value.
 *
 * A new setting of the last kind needs nothing in the console: it is drawn, sent, kept in addresses and asked for again from here.
 */

import { postJson, type Schemas } from "./client";
import { defaultsOf, type Described, membersOf } from "./described";
import { namedProbes, outputs, settings } from "./generated/contract";

export type StreamSettings = Omit<Schemas["RenderSettings"], "encoding">;
export type FrameHeader = Schemas["FrameMessage"];
export type Display = FrameHeader["display"];
export type Contact = Schemas["Contact"];
export type Output = Schemas["Scene"]["outputs"][number];

/** `isNumbers`: whether the pixels of an output are numbers that stand for something; else they are shares. */
export const OUTPUTS = Object.fromEntries(
  (outputs.items?.oneOf ?? []).map((one) => [one.const, { isNumbers: one["x-numbers"] ?? false, meaning: one.description ?? "" }]),
) as Record<Output, { isNumbers: boolean; meaning: string }>;

/** The settings that have a place of their own in the console. */
const OF_THEIR_OWN = [
  "height", "width", "probe", "display", "outputs", "tools", "min_confidence", "below_min_confidence", "registration", "encoding",
] as const; // prettier-ignore
/** All other settings of frames; null: as the service takes it. */
export type PlainSettings = Omit<StreamSettings, (typeof OF_THEIR_OWN)[number]>;
export const PLAIN_SETTINGS = Object.fromEntries(
  Object.entries(settings.properties!).filter(([name]) => !OF_THEIR_OWN.some((own) => own === name)),
) as Record<keyof PlainSettings, Described>;
export const AS_TRAINED = defaultsOf({ properties: PLAIN_SETTINGS }) as unknown as PlainSettings;

export const DISPLAY = settings.properties!.display!;
export const AS_RENDERED = defaultsOf(DISPLAY) as unknown as Display;

/** What renders a frame again, as B-mode: all settings that it tells. The poses that frames tell lead into the scene. */
export function settingsAgain(header: FrameHeader): StreamSettings {
  const { rendered_height: height, rendered_width: width } = header;
  const known = { ...defaultsOf(settings), ...header, height, width, outputs: ["bmode"], registration: null };
  const asked = Object.entries(known).filter(([name]) => name in settings.properties! && name !== "encoding");
  return Object.fromEntries(asked) as unknown as StreamSettings;
}

export type Probe = NonNullable<Schemas["DatasetRecord"]["probe"]>;
/** Where the scan lines run in the image plane. */
export type ImagePlane = Schemas["ImagePlane"];

/** The numbers that a probe of each kind is made of. */
export const PROBE_KINDS = membersOf<string>(settings.properties!.probe!);

/** Probes as makers call them, such as L12-4. */
export const NAMED_PROBES = namedProbes as Record<string, Probe>;

/** A probe of that kind which looks so deep. */
export function exampleProbe(kind: string, depth_mm: number): Probe {
  const example = PROBE_KINDS.get(kind)?.examples?.[0] as Probe & { near_mm?: number };
  return { ...example, far_mm: (example.near_mm ?? 0) + depth_mm };
}

/** Throws ServiceError for a probe that cannot be. */
export const imagePlane = (probe: Probe): Promise<ImagePlane> => postJson("/v1/probes:plane", {}, probe);

export type Tool = NonNullable<StreamSettings["tools"]>[number];
export type ToolKind = Tool["kind"];
export type ToolFrame = Tool["frame"];

/** What a tool of each kind is made of. */
export const TOOL_KINDS = membersOf<ToolKind>(settings.properties!.tools!.items!);
/** Of one frame. */
export const MOST_TOOLS = settings.properties!.tools!.maxItems!;
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
