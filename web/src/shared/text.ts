/** Amounts, times and names as people read and write them, in any language. */

const UNITS = ["B", "KB", "MB", "GB", "TB"];

export function bytes(count: number): string {
  const power = Math.min(UNITS.length - 1, Math.floor(Math.log10(Math.max(1, count)) / 3));
  const value = count / 1000 ** power;
  return `${value.toFixed(power === 0 || value >= 100 ? 0 : 1)} ${UNITS[power]}`;
}

export function duration(seconds: number): string {
  const whole_s = Math.round(seconds);
  if (whole_s < 60) return `${whole_s} s`;
  if (whole_s < 3600) return `${Math.floor(whole_s / 60)} min ${whole_s % 60} s`;
  const whole_min = Math.round(seconds / 60);
  return `${Math.floor(whole_min / 60)} h ${whole_min % 60} min`;
}

/** A name that scenes and datasets may have, made of a file's. */
export function nameOfFile(file: string): string {
  const stem = file.replace(/(\.igs)?\.[A-Za-z0-9]+$/, "").replace(/\.tar$/, "");
  return stem.replace(/[^A-Za-z0-9._-]+/g, "-").replace(/^[._-]+/, "").slice(0, 128);
}

export const NAME_PATTERN = "[A-Za-z0-9][A-Za-z0-9._\\-]{0,127}";
