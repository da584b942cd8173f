/** What charts draw. */

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
