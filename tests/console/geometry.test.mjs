/** Pictures on the planes of any probe: web/src/geometry without a browser. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { built } from "./sources.mjs";

const { areAllAround, areUpright, boxOf, isShown, outline, pixelAt, placedOn, pointAt } = await built("geometry/plane");

const shares = Array.from({ length: 65 }, (_, i) => i / 64);
const radians = (degrees) => (degrees / 180) * Math.PI;
const ray = (degrees, near, far) => [near, far].flatMap((r) => [r * Math.sin(radians(degrees)), r * Math.cos(radians(degrees))]);
const steered = ([x, z, along]) => [x + along * Math.sin(radians(20)), z + along * Math.cos(radians(20))];
const PLANES = {
  linear: shares.map((share) => [40 * share - 20, 5, 40 * share - 20, 50]),
  convex: shares.map((share) => ray(60 * share - 30, 40, 90)),
  radial: shares.map((share) => ray(360 * share, 3, 20)),
  steered: shares.map((share) => [0, 45].flatMap((along) => steered([40 * share - 20, 0, along]))),
};
const FRAME = { height: 200, width: 128 };
const picture = { column_unit: "mm", first: [0, 0], step: [1, 1] };
const isWithin = (corners, [x, y]) =>
  corners.filter(([x0, y0], i) => {
    const [x1, y1] = corners.at(i - 1);
    return y0 > y !== y1 > y && x < x0 + ((y - y0) / (y1 - y0)) * (x1 - x0);
  }).length % 2 === 1;
const near = (a, b, most) => assert.ok(Math.abs(a - b) <= most, `${a} is not ${b}`);

describe("a frame as it is stored", () => {
  for (const [kind, lines_mm] of Object.entries(PLANES))
    it(`has its pixels along the scan lines: ${kind}`, () => {
      for (const [step, flipped] of [[1, false], [-1, true]]) {
        const placed = placedOn({ lines_mm, face_depth_mm: 0, pivot_depth_mm: 0 }, { ...FRAME, picture: { ...picture, step: [step, 1] } }, 0.5);
        for (const [column, row] of [[0, 0], [17, 40.5], [63.5, 100], [100.2, 160], [127, 199]]) {
          const point = pointAt(placed, column, row);
          const back = pixelAt(placed, point);
          near(back.column, column, 0.02);
          near(back.row, row, 0.02);
        }
        const [x0, z0, x1, z1] = lines_mm[flipped ? 64 : 0];
        const corner = pointAt(placed, -0.5, FRAME.height - 0.5); // the end of half of the first line
        near(corner.x_mm, (x0 + x1) / 2, 1e-9);
        near(corner.z_mm, (z0 + z1) / 2, 1e-9);
        assert.equal(outline(placed), null);
      }
    });
});

describe("a picture of square pixels", () => {
  /** Whether the point shows something of a plane whose picture goes down to `end_mm`. */
  const shows = (lines_mm, x_mm, z_mm, end_mm = boxOf(lines_mm).bottom) => {
    const { left, top } = boxOf(lines_mm);
    const step = [0.1, 0.1];
    const sized = { picture: { column_unit: "mm", first: [left + 0.05, top + 0.05], step }, width: 400, height: (end_mm - top) / 0.1 };
    const placed = placedOn({ lines_mm, face_depth_mm: 0, pivot_depth_mm: 0 }, sized, null);
    const { column, row } = pixelAt(placed, { x_mm, z_mm });
    const shown = isShown(placed, column, row);
    const at = [(column + 0.5) / placed.width, (row + 0.5) / placed.height];
    assert.equal(isWithin(outline(placed), at), shown, `the outline at ${x_mm}, ${z_mm}`);
    return shown;
  };

  it("shows a fan and leaves its corners", () => {
    assert.deepEqual([[0, 60], [0, 89], [40, 60], [0, 39], [-25, 60]].map(([x, z]) => shows(PLANES.convex, x, z)), [true, true, false, false, true]);
    assert.deepEqual([[0, 60], [0, 69], [0, 71]].map(([x, z]) => shows(PLANES.convex, x, z, 70)), [true, true, false]);
  });
  it("shows a disc with a hole", () => {
    assert.deepEqual([[0, 10], [0, -10], [10, 0], [-14, -13], [0, 2], [15, 15]].map(([x, z]) => shows(PLANES.radial, x, z)), [true, true, true, true, false, false]);
    assert.deepEqual([[0, 9], [0, 11], [-9, 0], [0, -11]].map(([x, z]) => shows(PLANES.radial, x, z, 10)), [true, false, true, false]);
  });
  it("shows a parallelogram", () => {
    assert.deepEqual([[-15, 10], [18, 40], [-18, 40], [33, 40], [0, 43]].map(([x, z]) => shows(PLANES.steered, x, z)), [true, true, false, true, false]);
  });
});

it("only a linear probe's frames are true to scale, only a radial one's go all around", () => {
  const which = (holds) => Object.keys(PLANES).filter((kind) => holds(PLANES[kind]));
  assert.deepEqual([which(areUpright), which(areAllAround)], [["linear"], ["radial"]]);
});
