/** The fields of the service's contract, probes and metrics in the language of the person. */

import type { Metric } from "../api/comparison";
import { labelOf } from "../api/described";
import type { Probe } from "../api/probes";
import { words } from "../words/words.svelte";
import { LABELS } from "./metrics";

/** The name of a field, or of a member of a closed set, and the unit by which the name ends. */
export function fieldLabel(name: string): { label: string; unit: string } {
  const { label, unit } = labelOf(name);
  return { label: words.shared.field.labels[name] ?? label, unit };
}

/** A probe in words: "Convex, opening angle 60.0°, near 40.0 mm, far 90.0 mm". */
export function probeInWords({ kind, ...numbers }: Probe): string {
  const described = Object.entries(numbers).map(([name, value]) => {
    const { label, unit } = fieldLabel(name);
    return `${label} ${value.toFixed(1)}${unit === "°" ? "" : " "}${unit}`;
  });
  return [fieldLabel(kind).label, ...described].join(", ");
}

/** The name of a metric of images. */
export function metricTitle(metric: Metric): string {
  return words.shared.field.labels[metric] ?? LABELS[metric].title;
}

/** Its name and unit. */
export function metricLabel(metric: Metric): string {
  const { unit } = LABELS[metric];
  return unit === "" ? metricTitle(metric) : `${metricTitle(metric)}, ${unit}`;
}
