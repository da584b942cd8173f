/** Edits of a scene that a person lines up, and the scene that the service makes by them. */

import { type Edit, EDIT_KINDS, editScene, MOST_EDITS, type Shape, shapesOf, withShape } from "../api/edits";
import { defaultsOf } from "../api/described";
import { pointOf } from "../geometry/plane";
import { apply, axis, type Vector } from "../geometry/pose";
import { isSolid, movedTo, shapeAt, type Solid, type Sphere, spheresTo } from "../geometry/shapes";
import { href, router } from "../page/router.svelte";
import { service } from "../page/service.svelte";
import { poseValue } from "../session/link";
import { besideSession, type Session, WorkList } from "../session/session.svelte";
import { Attempt } from "../shared/asking.svelte";

const SIZE_MM = 5; // of what is put in, until it is sized

export class Editing extends Attempt {
  readonly edits: WorkList<Edit>;
  /** The scene to make. */
  into = $state("");
  isPrivate = $state(false);
  /** Whether a press on the image puts the shape that is worked on there. */
  places = $state(true);
  /** Whether dragging across the image paints what is relabelled, with a brush of that radius. */
  paints = $state(true);
  brush_mm = $state(4);
  /** What is painted, until the brush is lifted. */
  #stroke = $state.raw<readonly Sphere[]>([]);
  readonly isPainted = $derived.by(() => this.paints && this.edits.current?.kind === "relabel");
  #shape = $state(0);
  readonly shapes = $derived.by(() => (this.edits.current === null ? [] : shapesOf(this.edits.current)));
  /** Which of the shapes of the edit that is worked on is. */
  readonly shape = $derived.by(() => Math.min(this.#shape, this.shapes.length - 1));
  /** The one that is placed by hand, where there is one. */
  readonly held = $derived.by((): Solid | null => {
    const shape = this.shapes[this.shape];
    return shape !== undefined && isSolid(shape) && !this.isPainted ? shape : null;
  });
  /** All that can be drawn, by edits: `isCurrent`: of the one that is worked on. */
  readonly bodies = $derived.by(() =>
    this.edits.all.map((edit, index) => {
      const isCurrent = index === this.edits.chosen;
      return { isCurrent, solids: [...shapesOf(edit).filter(isSolid), ...(isCurrent ? this.#stroke : [])] };
    }),
  );
  readonly solids = $derived.by(() => this.bodies.flatMap(({ solids }) => solids));

  constructor(readonly session: Session) {
    super();
    this.edits = new WorkList<Edit>(session.history, "edit", MOST_EDITS);
  }

  get name(): string {
    return this.into || service.freeName(this.session.name, "edited");
  }

  /** Adds an edit; what it is about begins in the middle of the image. */
  add(kind: Edit["kind"]): void {
    const described = EDIT_KINDS.get(kind)!;
    const shape = this.shapeOf(kind === "cut" ? "box" : "sphere");
    const begun: Record<string, unknown> = {
      shape,
      shapes: this.paints ? [] : [shape],
      scene: service.usable.find(({ name }) => name !== this.session.name)?.name ?? "",
      gaussian_count: Math.round((this.session.scene.description?.gaussian_count ?? 2) / 2),
    };
    const usual = defaultsOf(described);
    const open = Object.keys(usual).filter((name) => name in begun && (usual[name] === undefined || kind === "thin"));
    this.edits.add({ ...usual, ...Object.fromEntries(open.map((name) => [name, begun[name]])), kind } as Edit);
    this.#shape = 0;
  }

  /** A shape of that kind where the one that is worked on is, else in the middle of the image. */
  shapeOf(kind: Shape["kind"], at: Vector = this.#middle()): Shape {
    return shapeAt(kind, at, SIZE_MM, axis(this.session.pose, 1));
  }

  /** Works on another shape of the edit. */
  take(shape: number): void {
    this.#shape = shape;
  }

  /** Puts the shape that is worked on elsewhere. */
  putAt(middle: Vector): void {
    const { held, edits } = this;
    if (held !== null) edits.change(withShape(edits.current!, this.shape, movedTo(held, middle)));
  }

  /** Puts it into the image. */
  putInImage(): void {
    this.putAt(this.#middle());
  }

  /** Leads the brush to a place, from where it was put down or led to before. */
  paintTo(place: Vector): void {
    this.#stroke = [...this.#stroke, ...spheresTo(place, this.brush_mm, this.#stroke.at(-1) ?? null)];
  }

  /** Lifts the brush: the stroke becomes a part of the edit. */
  endStroke(): void {
    const { current } = this.edits;
    if (this.#stroke.length > 0 && current?.kind === "relabel")
      this.edits.changeInOneStep({ ...current, shapes: [...current.shapes, ...this.#stroke] });
    this.#stroke = [];
  }

  /** Has the service make the scene, and opens it where the probe is. */
  async save(): Promise<void> {
    const { session, name: into, isPrivate } = this;
    const isMade = await this.run(async (signal) => {
      await editScene(session.name, { into, edits: [...this.edits.all], private: isPrivate }, signal);
      await service.poll();
    });
    const named = /^edits\[(\d+)\]/.exec(this.field ?? "");
    if (named !== null) this.edits.choose(Number(named[1]));
    const { view, name } = router.route;
    if (!isMade || view !== "scan" || name !== session.name) return;
    this.into = "";
    location.hash = this.addressOf(into);
  }

  /** What is wrong with a value by its path, or with one within it that is no field of its own. */
  problemOf(path: string): string | null {
    const { field, problem } = this;
    return field !== null && field.startsWith(path) && /^(\[\d+\])*$/.test(field.slice(path.length)) ? problem : null;
  }

  /** Another scene, seen by the probe as it is held now. */
  addressOf(scene: string): string {
    return href("scan", scene, { ...router.kept, pose: poseValue(this.session.pose) });
  }

  #middle(): Vector {
    const { x_mm, z_mm } = pointOf(this.session.plane.lines_mm, 0.5, 0.5);
    return apply(this.session.pose, [x_mm, 0, z_mm]);
  }
}

/** The edits of a session; the same each time that they are shown. */
export const editingOf = besideSession((session) => new Editing(session));
