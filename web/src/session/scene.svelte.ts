/** What the service tells of a scene: its description, its own probe, the views that it was trained from, and the image planes of probes. */

import { SvelteMap } from "svelte/reactivity";

import { explain, mayPass, ServiceError, Unreachable } from "../api/client";
import { exampleProbe, type FrameHeader, imagePlane, type ImagePlane, type Probe, PROBE_KINDS } from "../api/contract";
import { describeScene, type SceneDescription, trainingPoses, type TrainingPoses } from "../api/scenes";
import { type Placed, placedOn } from "../geometry/plane";
import { IDENTITY, type Pose, type Vector } from "../geometry/pose";
import { skinOf } from "../geometry/skin";

const MOST_PLACED = 32;

/** The image planes of the probes that were seen, asked for once each. */
class Planes {
  #known = new SvelteMap<string, ImagePlane>();
  #asked = new Map<string, Promise<ImagePlane>>();
  #placed = new Map<string, Placed>();

  /** The plane of a probe. Throws ServiceError for one that cannot be. */
  get(probe: Probe): Promise<ImagePlane> {
    const key = keyOf(probe);
    const before = this.#asked.get(key);
    if (before !== undefined) return before;
    const asked = imagePlane(probe);
    this.#asked.set(key, asked);
    asked.then(
      (plane) => this.#known.set(key, plane),
      () => this.#asked.delete(key),
    );
    return asked;
  }

  /** The plane of a probe as far as it is known; else it is asked for, and what reads this is told. */
  of(probe: Probe): ImagePlane | null {
    const known = this.#known.get(keyOf(probe));
    if (known === undefined) this.get(probe).catch(() => undefined); // the next frame asks again
    return known ?? null;
  }

  /** Where the pixels of a frame lie, the same object for all frames alike; null until the plane is known. */
  placed({ probe, picture, height, width, rendered_height, display }: FrameHeader): Placed | null {
    const key = JSON.stringify([probe, picture, height, width, rendered_height, display.pixel_mm]);
    const before = this.#placed.get(key);
    if (before !== undefined) return before;
    const plane = this.of(probe);
    if (plane === null) return null;
    const shown = display.pixel_mm === null ? height / rendered_height : null;
    const placed = placedOn(plane, { picture, height, width }, shown);
    if (this.#placed.size >= MOST_PLACED) this.#placed.clear();
    this.#placed.set(key, placed);
    return placed;
  }
}

/** The same for probes that are the same. */
export function keyOf(probe: Probe): string {
  return JSON.stringify(Object.entries(probe).sort());
}

export const planes = new Planes();

/** A probe with its image plane. */
export interface Held {
  probe: Probe;
  plane: ImagePlane;
}

/** In place of the own probe of a scene that has none. */
const SUBSTITUTE = exampleProbe([...PROBE_KINDS.keys()][0]!, 50);
/** Until a scene is known. */
const NOTHING: Held = {
  probe: SUBSTITUTE,
  plane: { face_depth_mm: 0, pivot_depth_mm: 0, lines_mm: [[-20, 0, -20, 50], [20, 0, 20, 50]] }, // prettier-ignore
};

const UNKNOWN_BOUNDS = { min_mm: { x: -50, y: -50, z: -50 }, max_mm: { x: 50, y: 50, z: 50 } };

/** What the service tells of a scene: its description, its own probe, the views that it was trained from. */
export class KnownScene {
  description = $state.raw<SceneDescription | null>(null);
  /** Why there is no description. */
  problem = $state<string | null>(null);
  missing = $state(false);
  /** The views that the scene was trained from. */
  views = $state.raw<Pose[]>([]);
  /** How far each was corrected in the training; null: none was. */
  corrections = $state.raw<Pick<TrainingPoses, "shift_mm" | "turn_deg"> | null>(null);
  /** The probe that it was trained with. */
  own = $state.raw<Held>(NOTHING);
  /** Whether frames have come from another file since the description was asked for. */
  outdated = $state(false);

  readonly known = $derived(this.description !== null);
  readonly home = $derived(this.views[Math.floor(this.views.length / 2)] ?? middleOf(this.description));
  /** Through the faces of the views; null where they look in all directions. */
  readonly skin = $derived.by(() => skinOf(this.views, this.own.plane));
  /** The box that it fills, mm; a guess until it is known. */
  readonly bounds = $derived.by((): { low: Vector; high: Vector } => {
    const { min_mm: low, max_mm: high } = this.description?.bounds ?? UNKNOWN_BOUNDS;
    return { low: [low.x, low.y, low.z], high: [high.x, high.y, high.z] };
  });
  #asking = false;
  #sha256: string | null = null;

  constructor(
    readonly name: string,
    /** What is done when the scene is known, or another one has its name. */
    private readonly onanew: () => void,
  ) {}

  /** Asks the service about the scene. */
  async load(): Promise<void> {
    if (this.#asking) return;
    this.#asking = true;
    const sha256 = this.#sha256;
    try {
      const description = await describeScene(this.name);
      if (!sameScene(this.description, description)) await this.#take(description);
      if (sha256 === this.#sha256) this.outdated = false;
      this.problem = null;
      this.missing = false;
    } catch (error) {
      this.problem = error instanceof Unreachable ? null : explain(error);
      this.missing = error instanceof ServiceError && error.reason === "SCENE_NOT_FOUND";
    } finally {
      this.#asking = false;
    }
  }

  /** Takes note of the file that a frame came from. */
  rendered(sha256: string): void {
    if (this.#sha256 !== null && this.#sha256 !== sha256) this.outdated = true;
    this.#sha256 = sha256;
  }

  async #take(description: SceneDescription): Promise<void> {
    if (sameScene(this.description && withoutLabels(this.description), withoutLabels(description))) {
      this.description = description;
      return;
    }
    const probe = description.probe ?? SUBSTITUTE;
    const plane = await planes.get(probe);
    const known = description.training_poses.count > 0 ? await viewsOf(this.name) : null;
    this.views = known?.poses ?? [];
    this.corrections = known?.shift_mm ? known : null;
    this.description = description;
    this.own = { probe, plane };
    this.onanew();
  }
}

/** Whether both tell of one scene file. */
function sameScene(before: SceneDescription | null, now: SceneDescription): boolean {
  const lasting = (scene: SceneDescription): string => JSON.stringify({ ...scene, loaded: null, loaded_processes: null });
  return before !== null && lasting(before) === lasting(now);
}

/** A description that other labels leave as it is. */
function withoutLabels(scene: SceneDescription): SceneDescription {
  return { ...scene, label_names: {}, file_bytes: 0, outputs: [] };
}

async function viewsOf(scene: string): Promise<TrainingPoses | null> {
  try {
    return await trainingPoses(scene);
  } catch (error) {
    if (mayPass(error)) throw error;
    return null;
  }
}

function middleOf(description: SceneDescription | null): Pose {
  return description?.training_poses.middle?.matrix.flat() ?? IDENTITY;
}
