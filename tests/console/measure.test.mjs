/** Measuring, letters and places on a track: web/src/geometry without a browser. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { built } from "./sources.mjs";

const geometry = await built("geometry/plane", "geometry/pose");

const point = (x_mm, z_mm) => ({ x_mm, z_mm });
const near = (a, b, most) => assert.ok(Math.abs(a - b) <= most, `${a} is not ${b}`);

describe("an ellipse", () => {
  it("of equal axes is a circle", () => {
    const circle = geometry.ellipseOf([point(-5, 3), point(5, 3), point(0, 8)]);
    near(geometry.area_mm2(circle), 25 * Math.PI, 1e-9);
    near(geometry.circumference_mm(circle), 10 * Math.PI, 1e-9);
  });

  it("has the circumference of the integral", () => {
    for (const [a, b] of [[10, 6], [10, 1], [3, 8], [10, 0]]) {
      const steps = 200_000;
      let length = 0;
      for (let i = 0; i < steps; i++) {
        const t = ((i + 0.5) / steps) * 2 * Math.PI;
        length += (Math.hypot(a * Math.sin(t), b * Math.cos(t)) * 2 * Math.PI) / steps;
      }
      near(geometry.circumference_mm({ first_mm: a, second_mm: b }) / length, 1, 5e-4);
    }
  });

  it("keeps its second axis square to the first, and as long, while an end moves", () => {
    const [a, b, c] = [point(0, 0), point(10, 0), point(5, 3)];
    const moved = point(10, 10);
    const third = geometry.carried([a, b, c], a, moved);
    const { centre, second_mm } = geometry.ellipseOf([a, moved, third]);
    near(second_mm, 3, 1e-9);
    near((third.x_mm - centre.x_mm) * moved.x_mm + (third.z_mm - centre.z_mm) * moved.z_mm, 0, 1e-9);
    near(third.z_mm - centre.z_mm, 3 / Math.SQRT2, 1e-9); // on the side where it was
  });
});

describe("an angle", () => {
  it("is that between its arms, whichever comes first", () => {
    const [a, vertex, b] = [point(10, 0), point(0, 0), point(0, 4)];
    near(geometry.angleAt_deg([a, vertex, b]), 90, 1e-9);
    near(geometry.angleAt_deg([b, vertex, a]), 90, 1e-9);
    near(geometry.angleAt_deg([a, vertex, point(-3, 0)]), 180, 1e-9);
    near(geometry.angleAt_deg([a, vertex, point(Math.sqrt(3), 1)]), 30, 1e-9);
  });
});

describe("letters", () => {
  it("of marks that cross do not print over each other", () => {
    const size = { width: 11, height: 15 };
    const labels = [[100, 100], [101, 99], [98, 103], [100, 100], [105, 95]].map(([x, y]) => ({ x, y, ...size }));
    const boxes = geometry.placeLabels(labels, { left: 0, top: 0, width: 300, height: 200 });
    for (const [i, one] of boxes.entries())
      for (const other of boxes.slice(i + 1)) assert.equal(geometry.overlap(one, other), false);
  });

  it("stay on the picture", () => {
    const [box] = geometry.placeLabels([{ x: 299, y: 1, width: 11, height: 15 }], { left: 0, top: 0, width: 300, height: 200 });
    assert.ok(box.left + box.width <= 300 && box.top >= 0);
  });
});

describe("a pose on a track", () => {
  const track = [0, 1, 3].map((y) => geometry.fromPositionQuaternion([0, y, 0], [Math.cos(y / 10), Math.sin(y / 10), 0, 0]));

  it("is found at a view and between two", () => {
    assert.equal(geometry.placeOn(track, track[2]), 2);
    near(geometry.placeOn(track, geometry.between(track[1], track[2], 0.25)), 1.25, 1e-6);
  });

  it("is not found beside it", () => {
    assert.equal(geometry.placeOn(track, geometry.translated(track[1], [1, 0, 0])), null);
    assert.equal(geometry.placeOn([], track[0]), null);
  });
});
