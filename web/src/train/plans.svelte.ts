/** What is prepared in Train: a training with its settings, or a data set to be rendered. Both outlive the view. */

import { explain, mayPass, pauseAfter } from "../api/client";
import { defaultsOf, type Described, labelOf } from "../api/described";
import { JOB_KINDS, trainingPresets, trainingSettings } from "../api/generated/work";
import { estimateRendering, type Job, type JobEstimate, startJob } from "../api/jobs";
import { describeScene, type SceneDescription } from "../api/scenes";
import { namedValues } from "../shared/text";

export type Value = number | string | boolean | null;

export const SETTINGS: readonly [string, Described][] = Object.entries(trainingSettings.properties ?? {});

/** The training that is prepared: its name, preset and settings, and the earlier run that it repeats. It outlives the view. */
class TrainingPlan {
  /** What the person called the scene; null: a free name is proposed. */
  scene = $state<string | null>(null);
  preset = $state("fast");
  /** What differs from the preset, by name. */
  settings = $state<Record<string, Value>>({});
  isPrivate = $state(false);
  /** The run that is repeated with changes. */
  earlier = $state.raw<Job | null>(null);
  /** Names of settings whose input holds what cannot be meant, with the reason. */
  problems = $state<Record<string, string>>({});
  readonly isSound = $derived(Object.keys(this.problems).length === 0);
  readonly changed = $derived(Object.keys(this.settings));

  /** The value of a setting where nobody changes it. */
  defaultOf(name: string): Value {
    return presetValue(this.preset, name);
  }

  /** The value that the earlier run had; undefined: there is none. */
  before(name: string): Value | undefined {
    if (this.earlier === null) return undefined;
    const { preset = "fast", settings = {} } = this.earlier.specification;
    return name in settings ? (settings[name] as Value) : presetValue(preset, name);
  }

  valueOf(name: string): Value {
    return name in this.settings ? this.settings[name]! : this.defaultOf(name);
  }

  /** Sets a value; the preset's own is none that is changed. */
  set(name: string, value: Value): void {
    const { [name]: _, ...others } = this.settings;
    this.settings = Object.is(value, this.defaultOf(name)) ? others : { ...others, [name]: value };
    const { [name]: __, ...problems } = this.problems;
    this.problems = problems;
  }

  /** Begins with what an earlier training was specified by. */
  repeat(job: Job): void {
    this.earlier = job;
    this.preset = job.specification.preset ?? "fast";
    this.settings = { ...(job.specification.settings as Record<string, Value> | undefined) };
    this.isPrivate = job.private;
    this.scene = null;
    this.problems = {};
  }

  reset(): void {
    this.earlier = null;
    this.settings = {};
    this.problems = {};
    this.preset = "fast";
  }

  async start(dataset: string, scene: string): Promise<Job> {
    const settings = { ...this.settings };
    const job = await startJob("train", { dataset, scene, preset: this.preset, settings }, this.isPrivate);
    this.scene = null;
    return job;
  }
}

function presetValue(preset: string, name: string): Value {
  const own = trainingPresets[preset] ?? {};
  return (name in own ? own[name] : (trainingSettings.properties?.[name]?.default ?? null)) as Value;
}

/** What a person typed for a setting, or what is wrong with it, in the words that are given. */
export function readSetting(
  text: string,
  field: Described,
  said: { number: string; whole: string; least: (low: string) => string; above: (low: string) => string; most: (high: string) => string; none: string },
): { value: Value } | { problem: string } {
  const typed = text.trim();
  if (field.nullable && (typed === "" || typed.toLowerCase() === said.none)) return { value: null };
  if (field.type === "string") return { value: typed };
  const value = Number(typed);
  if (typed === "" || !Number.isFinite(value)) return { problem: said.number };
  if (field.type === "integer" && !Number.isInteger(value)) return { problem: said.whole };
  if (field.minimum !== undefined && value < field.minimum) return { problem: said.least(String(field.minimum)) };
  if (field.exclusiveMinimum !== undefined && value <= field.exclusiveMinimum) return { problem: said.above(String(field.exclusiveMinimum)) };
  if (field.maximum !== undefined && value > field.maximum) return { problem: said.most(String(field.maximum)) };
  return { value };
}

/** Whether a setting has to do with what is searched. */
export function matches(name: string, { description = "" }: Described, search: string): boolean {
  const text = `${name} ${labelOf(name).label} ${description}`.toLowerCase();
  return search.toLowerCase().split(/\s+/).every((word) => text.includes(word));
}

export const trainingPlan = new TrainingPlan();

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

const ADVISED_CONFIDENCE = 0.7; // as the tutorial has it

/** The data set that is prepared: its scene, sampler and files, and what the service expects of it. It outlives the view. */
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
  /** Whether nobody has said yet how little confidence will do. */
  #advises = true;

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
    if (this.#advises) this.given = withoutNull({ ...this.given, min_confidence: found?.confidence ? ADVISED_CONFIDENCE : null });
  }

  choose(kind: string): void {
    this.kind = kind;
    this.sampler = { ...STARTS[kind] };
  }

  samplerValues(): Record<string, unknown> {
    return { ...defaultsOf(SAMPLERS.get(this.kind) ?? {}), ...this.sampler };
  }

  set(name: string, value: unknown): void {
    if (name === "min_confidence") this.#advises = false;
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
    this.#advises = false;
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
