/** Numbers and times as people read them. */

const UNITS = ["B", "KB", "MB", "GB", "TB"];

export function bytes(count: number): string {
  const power = Math.min(UNITS.length - 1, Math.floor(Math.log10(Math.max(1, count)) / 3));
  const value = count / 1000 ** power;
  return `${value.toFixed(power === 0 || value >= 100 ? 0 : 1)} ${UNITS[power]}`;
}

export function count(value: number): string {
  return value.toLocaleString("en");
}

export function duration(seconds: number): string {
  if (seconds < 60) return `${Math.round(seconds)} s`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min ${Math.round(seconds % 60)} s`;
  return `${Math.floor(seconds / 3600)} h ${Math.round((seconds % 3600) / 60)} min`;
}

export function localTime(iso: string): string {
  return new Date(iso).toLocaleString([], { dateStyle: "short", timeStyle: "medium" });
}

/** A name that scenes and datasets may have, made of a file's. */
export function nameOfFile(file: string): string {
  const stem = file.replace(/(\.igs)?\.[A-Za-z0-9]+$/, "").replace(/\.tar$/, "");
  return stem.replace(/[^A-Za-z0-9._-]+/g, "-").replace(/^[._-]+/, "").slice(0, 128);
}

export const NAME_PATTERN = "[A-Za-z0-9][A-Za-z0-9._\\-]{0,127}";
