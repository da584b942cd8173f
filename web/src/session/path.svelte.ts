/** The path of the probe in a session: poses of a file or a recording, with their times. */

import { explain } from "../api/client";
import { distance_mm, nearest, type Pose, smoothPath } from "../geometry/pose";
import { type Chosen, MOST_BYTES, PoseError, type PoseFile, readPoses } from "../geometry/pose_files";
import { words } from "../words/words.svelte";
import { besideSession, type Session } from "./session.svelte";

const EVERY_MS = 33;
const PER_SECOND = 30; // poses between keyframes
const MOST_RECORDED = 100_000;

export class Path {
  /** The file that is played, as it was read. */
  file = $state.raw<PoseFile | null>(null);
  times_s = $state.raw<number[] | null>(null);
  /** Why a file is not played, in words. */
  problem = $state<string | null>(null);
  recording = $state(false);
  /** Whether the recording ended by itself. */
  isFull = $state(false);
  recorded = $state({ count: 0, seconds: 0 });
  /** Poses that a smooth path leads through, and the time from each to the next. */
  keyframes = $state.raw<Pose[]>([]);
  seconds = $state(2);
  readonly poses = $derived.by(() => this.session.trajectory?.poses ?? []);
  readonly length_mm = $derived(this.poses.reduce((sum, pose, i) => sum + (i > 0 ? distance_mm(pose, this.poses[i - 1]!) : 0), 0));
  #source: { name: string; buffer: ArrayBuffer } | null = null;
  #timer: ReturnType<typeof setInterval> | undefined;
  #taken: { pose: Pose; time_s: number }[] = [];
  #number = 0;

  constructor(private readonly session: Session) {}

  /** Reads a file and plays it. */
  async load(file: File): Promise<void> {
    const isSequence = /\.mh[ad]$/i.test(file.name); // images follow its poses
    if (file.size > MOST_BYTES && !isSequence) {
      this.problem = words.connect.path.wrong(file.name, words.connect.path.tooLarge);
      return;
    }
    try {
      this.#source = { name: file.name, buffer: await file.slice(0, MOST_BYTES).arrayBuffer() };
    } catch (error) {
      this.problem = words.connect.path.wrong(file.name, explain(error)); // it has changed on the disk, or is a folder
      return;
    }
    this.#read({});
  }

  /** Reads the file again, another way. */
  choose(chosen: Chosen): void {
    this.#read({ ...(this.file?.unitIsKnown === false && { unit: this.file.unit }), ...chosen });
  }

  #read(chosen: Chosen): void {
    if (this.#source === null) return;
    const { name, buffer } = this.#source;
    this.problem = null;
    try {
      const file = readPoses(name, buffer, chosen);
      this.#play(name, file.poses, file.times_s);
      this.file = file;
    } catch (error) {
      const reason = error instanceof PoseError ? error.said(words.connect.poseError) : explain(error);
      this.problem = words.connect.path.wrong(name, reason);
    }
  }

  /** The training sweep again. */
  leave(): void {
    this.problem = null;
    this.#source = this.file = this.times_s = null;
    this.session.follow(null);
  }

  /** Leads a smooth path through poses, `seconds` from each to the next; it is played where there are two. */
  lead(keyframes: Pose[], seconds = this.seconds): void {
    [this.keyframes, this.seconds, this.problem] = [keyframes, seconds, null];
    if (keyframes.length < 2) return;
    const poses = smoothPath(keyframes, Math.round(PER_SECOND * seconds));
    const { trainedPose } = this.session;
    this.#source = this.file = null;
    this.#play(words.connect.path.keyframesOf(keyframes.length), poses, poses.map((_, index) => index / PER_SECOND));
    if (!this.session.frozen) this.session.goTo(nearest(poses, trainedPose)); // where the probe was
  }

  /** Takes down what the probe does, until `stop`. */
  record(): void {
    this.#taken = [];
    this.isFull = false;
    this.recording = true;
    const begun_ms = performance.now();
    const take = (): void => {
      const time_s = (performance.now() - begun_ms) / 1000;
      this.#taken.push({ pose: this.session.trainedPose, time_s });
      this.recorded = { count: this.#taken.length, seconds: time_s };
      if (this.#taken.length >= MOST_RECORDED) {
        this.isFull = true;
        this.stop();
      }
    };
    take();
    this.#timer = setInterval(take, EVERY_MS);
  }

  /** Ends the recording, which is then what is played. */
  stop(): void {
    clearInterval(this.#timer);
    this.recording = false;
    this.#number += 1;
    this.#source = this.file = null;
    const poses = this.#taken.map(({ pose }) => pose);
    this.#play(words.connect.path.recorded(this.#number), poses, this.#taken.map(({ time_s }) => time_s));
  }

  #play(name: string, poses: Pose[], times_s: number[] | null): void {
    this.session.follow({ name, poses });
    this.times_s = times_s;
  }
}

/** That of a session; the same for every view. */
export const pathOf = besideSession((session) => new Path(session));
