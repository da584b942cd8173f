/** The training that is prepared: its name, preset and settings, and the earlier run that it repeats. It outlives the view. */

import { labelOf, type Described } from "../api/described";
import { trainingPresets, trainingSettings } from "../api/generated/work";
import { startJob, type Job } from "../api/jobs";

export type Value = number | string | boolean | null;

export const SETTINGS: readonly [string, Described][] = Object.entries(trainingSettings.properties ?? {});

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
