/** What charts draw: their series, their scales with round ticks, and the numbers beside them. */

export interface Point {
  x: number;
  y: number | null;
}

export interface Series {
  /** What tells it from others of the same label; else the label does. */
  id?: string;
  label: string;
  /** 1 to 6: which colour of the charts. */
  colour: 1 | 2 | 3 | 4 | 5 | 6;
  /** A y of null: a gap. */
  points: readonly Point[];
  dots?: boolean;
  /** Beside what the chart is about: an earlier run, say. */
  dashed?: boolean;
}

/** A value to compare with, drawn across the chart. */
export interface Level {
  label: string;
  y: number;
}

/** The path of a series; `place` says where a point lies in pixels. Between dots the line goes on over gaps. */
export function pathOf(one: Series, place: (x: number, y: number) => readonly [number, number]): string {
  let path = "";
  let pen = "M";
  for (const { x, y } of one.points) {
    if (y === null || !Number.isFinite(y)) {
      if (!one.dots) pen = "M";
      continue;
    }
    path += pen + place(x, y).map((at) => at.toFixed(1)).join(" ");
    pen = "L";
  }
  return path;
}

/** The points to be drawn as dots: all, or those that no line goes to. */
export function dotsOf({ points, dots }: Series): readonly Point[] {
  const known = (index: number): boolean => (points[index]?.y ?? null) !== null;
  return points.filter((_, index) => known(index) && (dots || !(known(index - 1) || known(index + 1))));
}

export function nearestOf(values: readonly number[], wanted: number): number {
  return values.reduce((best, value) => (Math.abs(value - wanted) < Math.abs(best - wanted) ? value : best));
}

/** The value of a series at a place: of dots the last one before it. */
export function valueAt({ points, dots }: Series, x: number): number | null {
  const found = dots ? points.findLast((point) => point.x <= x && point.y !== null) : points.find((point) => point.x === x);
  return found?.y ?? null;
}

export interface Range {
  low: number;
  high: number;
}

const MARGIN = 0.06; // of the values, above and below

/** The range of values, with room around them; `fromZero` begins it there. */
export function rangeOf(values: readonly number[], { fromZero = false, margin = true } = {}): Range {
  const known = values.filter(Number.isFinite);
  if (known.length === 0) return { low: 0, high: 1 };
  let low = known.reduce((least, value) => Math.min(least, value));
  let high = known.reduce((most, value) => Math.max(most, value));
  if (fromZero) low = Math.min(0, low);
  if (low === high) return fromZero && low === 0 ? { low: 0, high: 1 } : { low: low - 0.5, high: high + 0.5 };
  if (margin && !fromZero) [low, high] = [low - MARGIN * (high - low), high + MARGIN * (high - low)];
  else if (margin) high += MARGIN * (high - low);
  return { low, high };
}

/** Round numbers within the range, at most `most` of them (two at least are tried); whole ones where `whole`. */
export function ticks({ low, high }: Range, most: number, whole = false): number[] {
  const rough = (high - low) / Math.max(1, most);
  const power = 10 ** Math.floor(Math.log10(rough));
  const factors = whole ? [1, 2, 5, 10] : [1, 2, 2.5, 5, 10];
  const round = factors.map((factor) => factor * power).find((one) => one >= rough * (1 - 1e-9)) ?? 10 * power;
  const step = whole ? Math.max(1, Math.round(round)) : round;
  const first = Math.ceil(low / step - 1e-9);
  const last = Math.floor(high / step + 1e-9);
  return Array.from({ length: Math.max(0, last - first + 1) }, (_, i) => Number(((first + i) * step).toPrecision(12)));
}

/** How ticks are written: all with the same number of decimals, thousands as k where they are many. */
export function tickText(all: readonly number[], language = "en"): (value: number) => string {
  const largest = Math.max(0, ...all.map(Math.abs));
  const isThousands = largest >= 10_000 && all.every((value) => Math.abs((value / 100) % 1) < 1e-9);
  const shown = all.map((value) => (isThousands ? value / 1000 : value));
  const digits = Math.max(0, ...shown.map(decimals));
  return (value) => {
    const number = isThousands ? value / 1000 : value;
    const text = number.toLocaleString(language, { minimumFractionDigits: digits, maximumFractionDigits: digits });
    return isThousands && value !== 0 ? `${text}k` : text;
  };
}

function decimals(value: number): number {
  const text = Number(value.toPrecision(6)).toString();
  const [mantissa = "", exponent = "0"] = text.split("e");
  return Math.min(8, Math.max(0, (mantissa.split(".")[1]?.length ?? 0) - Number(exponent)));
}
