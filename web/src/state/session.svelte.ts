/** One scene as it is scanned: its description, the probe, where it is held and how its frames are shown. */

import { explain, mayPass, ServiceError, Unreachable } from "../api/client";
import { describeScene, trainingPoses, type Probe, type SceneDescription } from "../api/scenes";
import type { StreamSettings } from "../api/stream";
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

/** Poses to play, of the scene's own probe. */
export interface Trajectory {
  name: string;
  poses: Pose[];
}

export const TGC_POINTS = 6;
const AS_RENDERED_DB = 60; // the dynamic range that frames have
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
  /** What is played in place of the training sweep. */
  trajectory = $state.raw<Trajectory | null>(null);
  /** Where the probe was put last on the track, in its poses; between them too. */
  place = $state(0);
  /** null: the scene's own. */
  chosenProbe = $state.raw<Probe | null>(null);
  gain_db = $state(0);
  dynamicRange_db = $state(AS_RENDERED_DB);
  tgc_db = $state.raw<number[]>(new Array<number>(TGC_POINTS).fill(0));
  depth_mm = $state<number | null>(null);
  flip = $state(false);
  scanConverted = $state(true);
  /** Depth samples and scan lines; null: as trained. */
  samples = $state<number | null>(null);
  /** Whether what no Gaussians support is black. */
  hidesUnsupported = $state(false);

  /** Whether frames have come from another file since the description was asked for. */
  outdated = $state(false);

  readonly known = $derived(this.description !== null);
  readonly track = $derived(this.trajectory?.poses ?? this.views);
  readonly sceneProbe = $derived(this.description?.probe ?? WITHOUT_PROBE);
  readonly probe = $derived(this.chosenProbe ?? this.sceneProbe);
  readonly home = $derived(this.views[Math.floor(this.views.length / 2)] ?? middleOf(this.description));
  #placed = $state.raw<Pose | null>(null);
  /** Whether the probe is where the track last put it. */
  readonly onTrack = $derived(this.pose === this.#placed);
  #asking = false;
  #sha256: string | null = null;

  constructor(readonly name: string) {}

  /** Asks the service about the scene. */
  async load(): Promise<void> {
    if (this.#asking) return;
    this.#asking = true;
    const sha256 = this.#sha256;
    try {
      const description = await describeScene(this.name);
      if (!sameScene(this.description, description)) {
        this.views = description.training_poses.count > 0 ? await viewsOf(this.name) : [];
        this.description = description;
        this.#beginAnew();
      }
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

  /** What to ask the stream for; `plain`: without gain, range and TGC. */
  settings(outputs: string[], { plain = false } = {}): StreamSettings {
    const tgc = !plain && this.tgc_db.some((gain) => gain !== 0);
    return {
      height: this.samples,
      width: this.samples,
      probe: this.description?.probe ? this.chosenProbe : this.probe,
      display: {
        gain_db: plain ? 0 : this.gain_db,
        dynamic_range_db: plain ? AS_RENDERED_DB : this.dynamicRange_db,
        tgc_db: tgc ? this.tgc_db : [],
        depth_mm: this.depth_mm,
        flip: this.flip,
        pixel_mm: this.scanConverted ? squarePixel_mm(this.probe) : null,
      },
      outputs,
      min_confidence: this.hidesUnsupported && this.description?.confidence ? 1 : null,
      below_min_confidence: "mask",
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
    if (this.trajectory === null && this.views.length > 0) this.goTo(Math.floor(this.views.length / 2));
    else this.pose = this.held(this.home);
  }

  /** To a place of the track, in its poses. */
  goTo(place: number): void {
    this.place = Math.max(0, Math.min(this.track.length - 1, place));
    const before = this.track[Math.floor(this.place)];
    const after = this.track[Math.ceil(this.place)];
    if (before && after) this.pose = this.#placed = this.held(between(before, after, this.place % 1));
  }

  /** To the pose of the track that is nearest. */
  returnToTrack(): void {
    if (this.track.length > 0) this.goTo(nearest(this.track, this.trainedPose));
  }

  /** Takes poses to play, and goes to the first; null: the training sweep again. */
  follow(trajectory: Trajectory | null): void {
    this.trajectory = trajectory;
    if (trajectory === null) this.goHome();
    else this.goTo(0);
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
    const index = nearest(this.views, this.trainedPose);
    if (index < 0) return;
    if (this.trajectory === null) this.goTo(index);
    else this.pose = this.held(this.views[index]!);
  }

  /** Takes another probe, its face where that of the one before was. */
  chooseProbe(probe: Probe | null): void {
    const before = faceDepth_mm(this.probe);
    this.chosenProbe = probe;
    this.depth_mm = null;
    const { onTrack } = this;
    this.pose = translated(this.pose, [0, 0, before - faceDepth_mm(this.probe)]);
    if (onTrack) this.#placed = this.pose;
  }

  resetDisplay(): void {
    this.gain_db = 0;
    this.dynamicRange_db = AS_RENDERED_DB;
    this.tgc_db = new Array<number>(TGC_POINTS).fill(0);
    this.depth_mm = null;
    this.flip = false;
  }

  /** What was chosen for another scene of that name does not fit this one. */
  #beginAnew(): void {
    this.chosenProbe = this.trajectory = this.depth_mm = this.samples = null;
    this.goHome();
  }
}

/** Whether both tell of one scene file. */
function sameScene(before: SceneDescription | null, now: SceneDescription): boolean {
  const lasting = (scene: SceneDescription): string => JSON.stringify({ ...scene, loaded: null, loaded_processes: null });
  return before !== null && lasting(before) === lasting(now);
}

async function viewsOf(scene: string): Promise<Pose[]> {
  try {
    return await trainingPoses(scene);
  } catch (error) {
    if (mayPass(error)) throw error;
    return [];
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
  const known = sessions.get(scene);
  if (known !== undefined) return known;
  let session!: Session;
  $effect.root(() => void (session = new Session(scene))); // what it derives outlives the view that asked first
  sessions.set(scene, session);
  return session;
}

/** Lets go of what was kept about a scene that is gone. */
export function forgetSession(scene: string): void {
  sessions.delete(scene);
}
