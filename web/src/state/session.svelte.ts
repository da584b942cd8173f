/** One scene as it is scanned: its description, the probe, where it is held and how its frames are shown. */

import { explain, ServiceError, Unreachable } from "../api/client";
import { describeScene, trainingPoses, type Probe, type SceneDescription } from "../api/scenes";
import type { Output, StreamSettings } from "../api/stream";
import { faceDepth_mm, nearDepth_mm } from "../geometry/picture";
import {
  between,
  IDENTITY,
  nearest,
  pivoted,
  rotated,
  translated,
  type Pose,
  type Quaternion,
  type Vector,
} from "../geometry/pose";

export const TGC_POINTS = 6;
const MOST_PICTURE_PIXELS = 640; // on the longer side of a scan-converted fan
const WITHOUT_PROBE: Probe = { kind: "linear", width_mm: 40, near_mm: 0, far_mm: 50 };

export class Session {
  description = $state.raw<SceneDescription | null>(null);
  /** Why there is no description. */
  problem = $state<string | null>(null);
  missing = $state(false);
  /** The views that the scene was trained from. */
  views = $state.raw<Pose[]>([]);
  pose = $state.raw<Pose>(IDENTITY);
  /** Where the probe was put last in the sweep, in training views; between them too. */
  place = $state(0);
  /** null: the scene's own. */
  chosenProbe = $state.raw<Probe | null>(null);
  gain_db = $state(0);
  dynamicRange_db = $state(60);
  tgc_db = $state.raw<number[]>(new Array<number>(TGC_POINTS).fill(0));
  depth_mm = $state<number | null>(null);
  flip = $state(false);
  scanConverted = $state(true);
  /** Depth samples and scan lines; null: as trained. */
  samples = $state<number | null>(null);

  readonly sceneProbe = $derived(this.description?.probe ?? WITHOUT_PROBE);
  readonly probe = $derived(this.chosenProbe ?? this.sceneProbe);
  readonly home = $derived(this.views[Math.floor(this.views.length / 2)] ?? middleOf(this.description));
  #asking = false;

  constructor(readonly name: string) {}

  /** Asks the service about the scene. */
  async load(): Promise<void> {
    if (this.#asking) return;
    this.#asking = true;
    try {
      const description = await describeScene(this.name);
      const first = this.description === null;
      if (this.views.length === 0 && description.training_poses.count > 0) this.views = await viewsOf(this.name);
      this.description = description;
      this.problem = null;
      this.missing = false;
      if (first) this.goHome();
    } catch (error) {
      this.problem = error instanceof Unreachable ? null : explain(error);
      this.missing = error instanceof ServiceError && error.reason === "SCENE_NOT_FOUND";
    } finally {
      this.#asking = false;
    }
  }

  /** What to ask the stream for. */
  settings(outputs: Output[]): StreamSettings {
    return {
      height: this.samples,
      width: this.samples,
      probe: this.description?.probe ? this.chosenProbe : this.probe,
      display: {
        gain_db: this.gain_db,
        dynamic_range_db: this.dynamicRange_db,
        tgc_db: this.tgc_db.some((gain) => gain !== 0) ? this.tgc_db : [],
        depth_mm: this.depth_mm,
        flip: this.flip,
        pixel_mm: this.scanConverted ? squarePixel_mm(this.probe) : null,
      },
      outputs,
    };
  }

  /** Slides the probe along its own axes: lateral, elevation, axial. */
  moveBy(along_mm: Vector): void {
    this.pose = translated(this.pose, along_mm);
  }

  /** Turns the probe about its own axes, its face staying where it is. */
  turnBy(angles_deg: Vector): void {
    this.pose = rotated(this.pose, angles_deg, faceDepth_mm(this.probe));
  }

  /** Gives the probe another orientation, its face staying where it is. */
  turnTo(orientation: Quaternion): void {
    this.pose = pivoted(this.pose, orientation, faceDepth_mm(this.probe));
  }

  /** To the middle of the sweep. */
  goHome(): void {
    this.place = Math.floor(this.views.length / 2);
    this.pose = this.held(this.home);
  }

  /** To a place of the sweep, in training views. */
  goTo(place: number): void {
    this.place = Math.max(0, Math.min(this.views.length - 1, place));
    const before = this.views[Math.floor(this.place)];
    const after = this.views[Math.ceil(this.place)];
    if (before && after) this.pose = this.held(between(before, after, this.place % 1));
  }

  /** The pose that puts the face of the probe in use where that of the scene's own probe was. */
  held(view: Pose): Pose {
    return translated(view, [0, 0, faceDepth_mm(this.sceneProbe) - faceDepth_mm(this.probe)]);
  }

  /** The pose of the scene's own probe with its face where that of the probe in use is. */
  get trainedPose(): Pose {
    return translated(this.pose, [0, 0, faceDepth_mm(this.probe) - faceDepth_mm(this.sceneProbe)]);
  }

  /** To the nearest training view. */
  snap(): void {
    if (this.views.length > 0) this.goTo(nearest(this.views, this.trainedPose));
  }

  /** Takes another probe, its face where that of the one before was. */
  chooseProbe(probe: Probe | null): void {
    const before = faceDepth_mm(this.probe);
    this.chosenProbe = probe;
    this.depth_mm = null;
    this.pose = translated(this.pose, [0, 0, before - faceDepth_mm(this.probe)]);
  }

  resetDisplay(): void {
    this.gain_db = 0;
    this.dynamicRange_db = 60;
    this.tgc_db = new Array<number>(TGC_POINTS).fill(0);
    this.depth_mm = null;
    this.flip = false;
  }
}

async function viewsOf(scene: string): Promise<Pose[]> {
  try {
    return await trainingPoses(scene);
  } catch (error) {
    if (error instanceof ServiceError) return [];
    throw error;
  }
}

function middleOf(description: SceneDescription | null): Pose {
  return description?.training_poses.middle?.matrix.flat() ?? IDENTITY;
}

/** The pixel of a scan-converted picture; null for probes whose frames are pictures already. */
function squarePixel_mm(probe: Probe): number | null {
  if (probe.kind === "linear") return null;
  const half = (probe.opening_angle_deg / 360) * Math.PI;
  const across = 2 * probe.far_mm * Math.sin(Math.min(half, Math.PI / 2));
  const down = probe.far_mm - nearDepth_mm(probe) * Math.cos(half);
  return Math.max(across, down) / MOST_PICTURE_PIXELS;
}

const sessions = new Map<string, Session>();

/** The session of a scene; the same for every view. */
export function sessionOf(scene: string): Session {
  let session = sessions.get(scene);
  if (session === undefined) sessions.set(scene, (session = new Session(scene)));
  return session;
}
