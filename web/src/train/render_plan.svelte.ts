/** The data set that is prepared: its scene, sampler and files, and what the service expects of it. It outlives the view. */

import { explain, pauseAfter, mayPass } from "../api/client";
import { defaultsOf, type Described } from "../api/described";
import { JOB_KINDS } from "../api/job_kinds";
import { estimateRendering, startJob, type Job, type JobEstimate } from "../api/jobs";
import { describeScene, type SceneDescription } from "../api/scenes";
import { namedValues } from "../shared/local";

const SETTLE_MS = 350; // after the last change

const FIELDS: Readonly<Record<string, Described>> = JOB_KINDS.get("render")?.properties ?? {};
/** The samplers by kind. */
export const SAMPLERS: ReadonlyMap<string, Described> = new Map(
  (FIELDS.sampler?.oneOf ?? []).map((one) => [String(one.properties?.kind?.const), one]),
);
/** What a sampler needs that has no default. */
const STARTS: Record<string, Record<string, unknown>> = {
  around: { count: 1000 },
  covered: { count: 1000 },
  fan: { tilt_deg: 10, step_deg: 5 },
  spline: { count: 200 },
  training: {},
};
/** Those of its fields that say how frames are rendered, not where and into what. */
const OF_JOB = ["scene", "poses", "sampler", "format", "dtype", "shard_frames", "outputs", "max_run_s", "device", "min_memory_gb", "worker_labels", "min_confidence", "below_min_confidence"];

class RenderPlan {
  scene = $state("");
  /** What the service says of the scene; null: not yet. */
  description = $state.raw<SceneDescription | null>(null);
  kind = $state("around");
  sampler = $state.raw<Record<string, unknown>>({ ...STARTS.around });
  outputs = $state.raw<readonly string[]>(["bmode"]);
  /** What the person chose of the other fields. */
  given = $state.raw<Record<string, unknown>>({});
  others = $state("");
  estimate = $state.raw<JobEstimate | null>(null);
  problem = $state<string | null>(null);
  asking = $state(false);

  readonly specification = $derived.by<Record<string, unknown> | null>(() => {
    if (this.scene === "") return null;
    try {
      const sampler = { ...this.sampler, kind: this.kind };
      return { ...this.given, ...namedValues(this.others), scene: this.scene, sampler, outputs: [...this.outputs] };
    } catch {
      return null; // what is written below cannot be read yet
    }
  });
  /** How its frames are rendered. */
  readonly settings = $derived(
    Object.fromEntries(Object.entries(this.specification ?? {}).filter(([name]) => !OF_JOB.includes(name))),
  );

  /** Asks what the scene is; outputs that it does not have are not asked of it. */
  async describe(scene: string): Promise<void> {
    const found = await describeScene(scene).catch(() => null); // the estimate says what is wrong with it
    if (scene !== this.scene) return;
    this.description = found;
    const kept = this.outputs.filter((one) => found === null || found.outputs.some((output) => output === one));
    this.outputs = kept.length > 0 ? kept : ["bmode"];
  }

  choose(kind: string): void {
    this.kind = kind;
    this.sampler = { ...STARTS[kind] };
  }

  samplerValues(): Record<string, unknown> {
    return { ...defaultsOf(SAMPLERS.get(this.kind) ?? {}), ...this.sampler };
  }

  set(name: string, value: unknown): void {
    const { [name]: _, ...others } = this.given;
    this.given = value === null || value === FIELDS[name]?.default ? others : { ...others, [name]: value };
  }

  setSampler(name: string, value: unknown): void {
    const { [name]: _, ...others } = this.sampler;
    this.sampler = value === null ? others : { ...others, [name]: value };
  }

  repeat({ specification }: Job): void {
    const { scene, sampler, outputs, pose_count: _, ...given } = specification as Record<string, unknown>;
    const { kind = "training", ...settings } = (sampler ?? {}) as Record<string, unknown>;
    this.scene = String(scene);
    this.kind = String(kind);
    this.sampler = withoutNull(settings);
    this.outputs = (outputs as string[] | undefined) ?? ["bmode"];
    this.given = withoutNull(given);
    this.others = "";
  }

  /** Asks what comes of it, once it has been left alone for a moment; the answer ends that. */
  expect(specification: Record<string, unknown>): () => void {
    const ending = new AbortController();
    const { signal } = ending;
    this.asking = true;
    const ask = async (): Promise<void> => {
      try {
        this.estimate = await estimateRendering(specification, signal);
        this.problem = null;
      } catch (error) {
        if (signal.aborted) return;
        this.estimate = null;
        this.problem = explain(error);
        if (mayPass(error)) timer = setTimeout(() => void ask(), pauseAfter(error, 2000));
      }
      if (!signal.aborted) this.asking = false;
    };
    let timer = setTimeout(() => void ask(), SETTLE_MS);
    return () => {
      clearTimeout(timer);
      ending.abort();
    };
  }

  start(isPrivate: boolean): Promise<Job> {
    namedValues(this.others); // throws what is wrong with it
    return startJob("render", this.specification ?? {}, isPrivate);
  }
}

function withoutNull(values: Record<string, unknown>): Record<string, unknown> {
  return Object.fromEntries(Object.entries(values).filter(([, value]) => value !== null));
}

export const FIELDS_OF_RENDERING = FIELDS;
export const renderPlan = new RenderPlan();
