/** The edges of the box that the scene fills. */

import { BufferAttribute, BufferGeometry, LineBasicMaterial, LineSegments } from "three";

import { corners, type Box } from "./viewpoints";

const COLOUR = 0x6b7783;

export function boxLines(box: Box): LineSegments {
  const points = corners(box);
  const ends = points.flatMap((from, i) => [1, 2, 4].flatMap((bit) => (i & bit ? [] : [...from, ...points[i | bit]!])));
  const geometry = new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(ends), 3));
  return new LineSegments(geometry, new LineBasicMaterial({ color: COLOUR, transparent: true, opacity: 0.45 }));
}
