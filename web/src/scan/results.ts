/** What marks measure, in words and figures. */

import { angleAt_deg, area_mm2, circumference_mm, ellipseOf, type EllipsePoints } from "../geometry/measure";
import { placeLabels, type Box } from "../geometry/labels";
import { distanceBetween_mm } from "../geometry/picture";
import type { PlanePoint } from "../geometry/plane";
import { fixed } from "../shared/local";
import { words } from "../words/words.svelte";
import type { Mark, Marks } from "./marks.svelte";

const LETTER = { width: 11, height: 15 }; // at 13 pixels, of one

/** "12.0 × 8.0 mm, circumference 31.7 mm, area 0.75 cm²"; of an annotation its text. */
export function resultOf({ kind, points, text }: Mark): string {
  switch (kind) {
    case "distance":
      return `${fixed(distanceBetween_mm(points[0]!, points[1]!), 1)} mm`;
    case "angle":
      return `${fixed(angleAt_deg(points as EllipsePoints), 1)}°`;
    case "ellipse": {
      const ellipse = ellipseOf(points as EllipsePoints);
      return words.scan.results.ellipse({
        axes: `${fixed(2 * ellipse.first_mm, 1)} × ${fixed(2 * ellipse.second_mm, 1)} mm`,
        circumference: `${fixed(circumference_mm(ellipse), 1)} mm`,
        area: `${fixed(area_mm2(ellipse) / 100, 2)} cm²`,
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
