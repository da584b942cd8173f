/** Labels of tissue and of tools: where a scene has them, and what they are called. */

import type { Output } from "../api/outputs";
import type { Session } from "../session/session.svelte";
import { words } from "../words/words.svelte";

const LABELS: Output = "labels";

/** The outputs of a scene; labels are among them as soon as there is a tool in its image. */
export function outputsOf({ scene, tools }: Session): Output[] {
  const outputs = scene.description?.outputs ?? [];
  return tools.all.length === 0 || outputs.includes(LABELS) ? outputs : [...outputs, LABELS];
}

/** Names by label; what is both tissue and a tool has both names. */
export function labelNamesOf({ scene, tools }: Session): Record<string, string> {
  const names: Record<string, string[]> = {};
  for (const [label, name] of Object.entries(scene.description?.label_names ?? {})) names[label] = [name];
  for (const { kind, label } of tools.all) {
    const known = (names[label] ??= []);
    const name = words.tools.kinds[kind];
    if (!known.includes(name)) known.push(name);
  }
  return Object.fromEntries(Object.entries(names).map(([label, known]) => [label, known.join(", ")]));
}
