/** Amounts, times, names and metrics as people read and write them. */

import { type Output, OUTPUTS, type Probe } from "../api/contract";
import { labelOf } from "../api/described";
import type { Metric } from "../api/scenes";
import type { Named } from "../words/translated";
import { language, words } from "../words/words.svelte";

const UNITS = ["B", "KB", "MB", "GB", "TB"];

export function bytes(count: number): string {
  const power = Math.min(UNITS.length - 1, Math.floor(Math.log10(Math.max(1, count)) / 3));
  const value = count / 1000 ** power;
  const digits = power === 0 || value >= 100 ? 0 : 1;
  const written = value.toLocaleString(language.current, { minimumFractionDigits: digits, maximumFractionDigits: digits });
  return `${written} ${UNITS[power]}`;
}

export function duration(seconds: number): string {
  const whole_s = Math.round(seconds);
  if (whole_s < 60) return `${whole_s} s`;
  if (whole_s < 3600) return `${Math.floor(whole_s / 60)} min ${whole_s % 60} s`;
  const whole_min = Math.round(seconds / 60);
  return `${Math.floor(whole_min / 60)} h ${whole_min % 60} min`;
}

/** A name that scenes and datasets may have, made of a file's: letters without their marks, dashes for what cannot stand in it. */
export function nameOfFile(file: string): string {
  const stem = file.replace(/(\.igs)?\.[A-Za-z0-9]+$/, "").replace(/\.tar$/, "");
  const plain = stem.normalize("NFD").replace(/\p{Mark}/gu, "");
  return plain.replace(/[^A-Za-z0-9._-]+/g, "-").replace(/^[._-]+/, "").slice(0, 128);
}

export const NAME_PATTERN = "[A-Za-z0-9][A-Za-z0-9._\\-]{0,127}";

export function count(value: number): string {
  return value.toLocaleString(language.current);
}

const formats = new Map<string, Intl.NumberFormat>(); // making one takes longer than using it

/** With so many digits after the point. */
export function fixed(value: number, digits: number): string {
  const key = `${language.current} ${digits}`;
  let format = formats.get(key);
  if (format === undefined) {
    format = new Intl.NumberFormat(language.current, { minimumFractionDigits: digits, maximumFractionDigits: digits, useGrouping: false });
    formats.set(key, format);
  }
  return format.format(value);
}

/** A number as a person types it, with a point or a comma; NaN: it is none. */
export function numberOf(text: string): number {
  return text.trim() === "" ? NaN : Number(text.trim().replace("−", "-").replace(",", "."));
}

export function localTime(iso: string): string {
  return new Date(iso).toLocaleString(language.current, { dateStyle: "short", timeStyle: "medium" });
}

/** `name = value` a line, the values as JSON, or as text where they are none. Throws an Error in words. */
export function namedValues(lines: string): Record<string, unknown> {
  const values: Record<string, unknown> = {};
  for (const line of lines.split("\n").filter((one) => one.trim() !== "")) {
    const [name = "", ...value] = line.split("=");
    if (value.length === 0) throw new Error(words.shared.nameValue(line.trim()));
    values[name.trim()] = readValue(value.join("=").trim());
  }
  return values;
}

function readValue(text: string): unknown {
  try {
    return JSON.parse(text) as unknown;
  } catch {
    return text;
  }
}

/** The metrics of images. */
export const LABELS: Record<Metric, { title: string; unit: string; digits: number; higherIsBetter: boolean }> = {
  psnr_db: { title: "PSNR", unit: "dB", digits: 2, higherIsBetter: true },
  ms_ssim: { title: "MS-SSIM", unit: "", digits: 3, higherIsBetter: true },
  gms: { title: "GMS", unit: "", digits: 3, higherIsBetter: true },
  gmsd: { title: "GMSD", unit: "", digits: 3, higherIsBetter: false },
  histogram_distance: { title: "Histogram distance", unit: "", digits: 4, higherIsBetter: false },
};
export const METRICS = Object.keys(LABELS) as Metric[];

/** The name of a field, or of a member of a closed set, and the unit by which the name ends. */
export function fieldLabel(name: string): { label: string; unit: string } {
  const { label, unit } = labelOf(name);
  return { label: words.shared.field.labels[name] ?? label, unit };
}

/** The name of what the service has: as `names` have it, else as the service calls it. */
export function nameIn(names: Named, name: string): string {
  return names[name] ?? labelOf(name).label;
}

/** What an output is called and shows. */
export function outputWords(output: Output): { title: string; meaning: string } {
  return words.maps.outputs[output] ?? { title: labelOf(output).label, meaning: OUTPUTS[output].meaning };
}

/** A probe in words: "Convex, opening angle 60.0°, near 40.0 mm, far 90.0 mm". */
export function probeInWords({ kind, ...numbers }: Probe): string {
  const described = Object.entries(numbers).map(([name, value]) => {
    const { label, unit } = fieldLabel(name);
    return `${label} ${value.toFixed(1)}${unit === "°" ? "" : " "}${unit}`;
  });
  return [fieldLabel(kind).label, ...described].join(", ");
}

/** The name of a metric. */
export function metricTitle(metric: Metric): string {
  return words.shared.field.labels[metric] ?? LABELS[metric].title;
}

export function metricValue(value: number, metric: Metric): string {
  return fixed(value, LABELS[metric].digits);
}

/** Its name and unit. */
export function metricLabel(metric: Metric): string {
  const { unit } = LABELS[metric];
  return unit === "" ? metricTitle(metric) : `${metricTitle(metric)}, ${unit}`;
}
