/** What marks measure, in words and figures. */

import { angleAt_deg, area_mm2, circumference_mm, ellipseOf, type EllipsePoints } from "../geometry/measure";
import { placeLabels, type Box } from "../geometry/labels";
import { distanceBetween_mm } from "../geometry/picture";
import type { PlanePoint } from "../geometry/plane";
import { words } from "../words/words.svelte";
import type { Mark, Marks } from "./marks.svelte";

const LETTER = { width: 11, height: 15 }; // at 13 pixels, of one

/** "12.0 × 8.0 mm, circumference 31.7 mm, area 0.75 cm²"; of an annotation its text. */
export function resultOf({ kind, points, text }: Mark): string {
  switch (kind) {
    case "distance":
      return `${distanceBetween_mm(points[0]!, points[1]!).toFixed(1)} mm`;
    case "angle":
      return `${angleAt_deg(points as EllipsePoints).toFixed(1)}°`;
    case "ellipse": {
      const ellipse = ellipseOf(points as EllipsePoints);
      return words.scan.results.ellipse({
        axes: `${(2 * ellipse.first_mm).toFixed(1)} × ${(2 * ellipse.second_mm).toFixed(1)} mm`,
        circumference: `${circumference_mm(ellipse).toFixed(1)} mm`,
        area: `${(area_mm2(ellipse) / 100).toFixed(2)} cm²`,
      });
    }
    case "text":
      return text;
  }
}

export interface Lettered {
  letter: string;
  box: Box;
}

/** The letters of marks, each near its mark and none over another or over a point. */
export function lettersOf(
  shown: readonly Mark[],
  marks: Marks,
  screenOf: (point: PlanePoint) => { x: number; y: number },
  area: Box,
): Lettered[] {
  const lettered = shown.filter(({ kind }) => kind !== "text");
  const points = shown.flatMap((mark) => mark.points.map(screenOf));
  const taken = points.map(({ x, y }) => ({ left: x - 6, top: y - 6, width: 12, height: 12 }));
  const labels = lettered.map((mark) => ({ ...screenOf(mark.points.at(mark.kind === "angle" ? 1 : 0)!), ...LETTER }));
  const boxes = placeLabels(labels, area, taken);
  return lettered.map((mark, index) => ({ letter: marks.letterOf(mark.id), box: boxes[index]! }));
}
