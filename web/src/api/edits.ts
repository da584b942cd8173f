/** Edits of scenes: what there is, as the contract describes it, and the scene that the service makes by them. */

import { postJson, type Schemas } from "./client";
import { type Described, membersOf } from "./described";
import { edits } from "./generated/edits";
import type { SceneDescription } from "./scenes";

export type Edit = Schemas["EditBody"]["edits"][number];
export type Shape = Schemas["InsertEdit"]["shape"];

/** What an edit, or a shape, of each kind consists of. */
export const EDIT_KINDS: ReadonlyMap<Edit["kind"], Described> = membersOf(edits.items!);
export const SHAPE_KINDS: ReadonlyMap<Shape["kind"], Described> = membersOf(EDIT_KINDS.get("insert")!.properties!.shape!);
export const MOST_EDITS = edits.maxItems!;

/** Makes the scene `into` of a scene. */
export function editScene(scene: string, target: Schemas["EditBody"], signal: AbortSignal): Promise<SceneDescription> {
  return postJson("/v1/scenes/{scene}:edit", { scene }, target, signal);
}

/** The shapes that an edit is about. */
export function shapesOf(edit: Edit): readonly Shape[] {
  if ("shapes" in edit) return edit.shapes;
  return "shape" in edit && edit.shape !== null ? [edit.shape] : [];
}

/** The edit with another one in the place of one of them. */
export function withShape<One extends Edit>(edit: One, index: number, shape: Shape): One {
  return "shapes" in edit ? { ...edit, shapes: edit.shapes.map((before, at) => (at === index ? shape : before)) } : { ...edit, shape };
}
