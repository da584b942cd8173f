/** From where the scene is looked at, the skin, contact, and the volume: web/src without a browser. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { built } from "./sources.mjs";

const space = await built("geometry/pose", "geometry/skin", "space/volume", "space/appearance", "api/gaussians");
const { apply, axis, cross, dot, fromPositionQuaternion, length, minus, position, rotated, scaled, translated, unit } = space;

const near = (a, b, most, what) => assert.ok(Math.abs(a - b) <= most, `${what}: ${a} is not ${b}`);
const UPRIGHT = space.IDENTITY;
/** How a scene may lie: its axes are the tracker's, whatever they are. */
const ORIENTATIONS = {
  "as the demo": UPRIGHT,
  "turned about the axis by 180°": rotated(UPRIGHT, [0, 0, 180], 0),
  "turned about the axis by 90°": rotated(UPRIGHT, [0, 0, 90], 0),
  "probe from below": rotated(UPRIGHT, [180, 0, 0], 0),
  "probe along x": rotated(UPRIGHT, [0, 90, 0], 0),
  "probe along -y": rotated(UPRIGHT, [90, 0, 0], 0),
  askew: rotated(rotated(UPRIGHT, [35, -140, 70], 0), [12, 5, -3], 0),
};
const BOX = { low: [-30, -50, 0], high: [30, 50, 60] };

/** Where a direction goes on the screen: to the right, up. */
function onScreen({ position: eye, target, up }, direction) {
  const away = unit(minus(eye, target));
  const right = unit(cross(up, away));
  return { right: dot(direction, right), up: dot(direction, cross(away, right)) };
}

describe("from where the scene is looked at", () => {
  for (const [name, pose] of Object.entries(ORIENTATIONS))
    for (const flip of [false, true])
      it(`right is the right of the image, and the probe is above: ${name}${flip ? ", mirrored" : ""}`, () => {
        const views = [-20, 0, 20].map((along) => translated(pose, [0, along, 0]));
        const sides = space.sidesOf(pose, flip, views);
        const lateral = scaled(axis(pose, 0), flip ? -1 : 1);
        for (const viewpoint of ["whole", "behind", "top"]) {
          const seen = onScreen(space.lookFrom(viewpoint, sides, BOX, 34, 1.2), lateral);
          assert.ok(seen.right > 0.8, `${viewpoint}: the right of the image goes ${seen.right} to the right`);
          assert.ok(Math.abs(seen.up) < 0.5, `${viewpoint}: it goes ${seen.up} up`);
        }
        for (const viewpoint of ["whole", "behind", "side"]) {
          const seen = onScreen(space.lookFrom(viewpoint, sides, BOX, 34, 1.2), axis(pose, 2));
          assert.ok(seen.up < -0.8, `${viewpoint}: depth goes ${seen.up} up`);
        }
      });

  it("keeps the horizon of the sweep where the probe is tilted", () => {
    const views = [-20, 0, 20].map((along) => translated(UPRIGHT, [0, along, 0]));
    const { up } = space.sidesOf(rotated(UPRIGHT, [20, 15, 0], 0), false, views);
    near(dot(up, [0, 0, -1]), 1, 1e-9, "up");
  });

  it("sees all of the box from everywhere", () => {
    const tangent = Math.tan((17 / 180) * Math.PI);
    for (const viewpoint of ["whole", "behind", "side", "top"])
      for (const aspect of [0.5, 1, 2.4]) {
        const look = space.lookFrom(viewpoint, space.sidesOf(UPRIGHT, false, []), BOX, 34, aspect);
        const away = unit(minus(look.position, look.target));
        for (const corner of space.corners(BOX)) {
          const from = minus(corner, look.position);
          const seen = onScreen(look, from);
          const ahead = -dot(from, away);
          assert.ok(Math.abs(seen.up) <= ahead * tangent && Math.abs(seen.right) <= ahead * tangent * aspect, `${viewpoint} ${aspect}`);
        }
      }
  });
});

const LINES = Array.from({ length: 65 }, (_, i) => [i - 32, 0, i - 32, 50]);
const PLANE = { lines_mm: LINES, face_depth_mm: 0, pivot_depth_mm: 0 };
/** A sweep over a back: round across, in a frame of its own. */
const RADIUS_MM = 120;
const AXIS_MM = [10, -20, 40 + RADIUS_MM];
const onBack = (angle, along) => {
  const radians = (angle / 180) * Math.PI;
  const place = [AXIS_MM[0] - RADIUS_MM * Math.sin(radians), along, AXIS_MM[2] - RADIUS_MM * Math.cos(radians)];
  return rotated(fromPositionQuaternion(place, [1, 0, 0, 0]), [0, angle, 0], 0);
};
const BACK = [-25, -15, -5, 5, 15, 25].flatMap((angle) => [-40, -20, 0, 20, 40].map((along) => onBack(angle, along)));
const NARROW = { lines_mm: [[-6, 0, -6, 50], [0, 0, 0, 50], [6, 0, 6, 50]], face_depth_mm: 0, pivot_depth_mm: 0 }; // prettier-ignore

describe("the skin", () => {
  it("goes through the faces of the views", () => {
    const skin = space.skinOf(BACK, NARROW);
    for (const view of BACK) near(skin.above(position(view)), 0, 1.5, "height of a face");
    const out = skin.normal(position(onBack(15, 0)));
    assert.ok(dot(out, scaled(axis(onBack(15, 0), 2), -1)) > 0.98, `the skin looks to ${out}`);
  });

  it("is the same however the scene lies", () => {
    for (const [name, turn] of Object.entries(ORIENTATIONS)) {
      const views = BACK.map((view) => {
        const axes = [0, 1, 2].map((column) => minus(apply(turn, axis(view, column)), position(turn)));
        const [x, y, z] = apply(turn, position(view));
        return [axes[0][0], axes[1][0], axes[2][0], x, axes[0][1], axes[1][1], axes[2][1], y, axes[0][2], axes[1][2], axes[2][2], z, 0, 0, 0, 1];
      });
      const skin = space.skinOf(views, NARROW);
      for (const view of views) near(skin.above(position(view)), 0, 1.5, name);
    }
  });

  it("is none where the views look in all directions, or all around", () => {
    const around = [0, 60, 120, 180, 240, 300].map((angle) => onBack(angle, 0));
    assert.equal(space.skinOf(around, NARROW), null);
    const radial = Array.from({ length: 65 }, (_, i) => [3, 20].flatMap((r) => [r * Math.sin((i / 32) * Math.PI), r * Math.cos((i / 32) * Math.PI)]));
    assert.equal(space.skinOf(BACK, { ...NARROW, lines_mm: radial }), null);
    assert.equal(space.skinOf([UPRIGHT], PLANE), null);
  });
});

describe("contact", () => {
  const skin = space.skinOf(BACK, NARROW);
  const start = space.putOn(skin, onBack(0, 0), 0);
  const face = (pose, pivot) => apply(pose, [0, 0, pivot]);

  it("keeps the face on the skin wherever the probe is slid, and the probe's tilt against it", () => {
    let pose = start;
    for (let step = 0; step < 40; step++) pose = space.keptOn(skin, pose, translated(pose, [1, 0.2, 0]), 0);
    near(skin.above(position(pose)), 0, 0.1, "height");
    assert.ok(length(minus(position(pose), position(start))) > 30, "it did not slide");
    const tilt = (at) => Math.acos(Math.min(1, -dot(skin.normal(position(at)), axis(at, 2)))) * (180 / Math.PI);
    near(tilt(pose), tilt(start), 1, "degrees of tilt");
    assert.ok(Math.abs(tilt(UPRIGHT) - tilt(pose)) >= 0);
  });

  it("presses along the probe, keeps the press while it slides, and does not lift off", () => {
    const depth = (pose) => -skin.distance(position(pose), axis(pose, 2));
    let pose = space.keptOn(skin, start, translated(start, [0, 0, 4]), 0);
    near(depth(pose), 4, 0.1, "press");
    for (let step = 0; step < 20; step++) pose = space.keptOn(skin, pose, translated(pose, [-1, 0, 0]), 0);
    near(depth(pose), 4, 0.4, "press after sliding");
    pose = space.keptOn(skin, pose, translated(pose, [0, 0, -10]), 0);
    near(depth(pose), 0, 0.1, "press after lifting");
  });

  it("holds for a probe whose face is not at its origin", () => {
    const pivot = 40;
    let pose = space.putOn(skin, translated(start, [0, 0, -25]), pivot);
    near(skin.above(face(pose, pivot)), 0, 0.05, "height");
    for (let step = 0; step < 20; step++) pose = space.keptOn(skin, pose, translated(pose, [0.5, 1, 0]), pivot);
    near(skin.above(face(pose, pivot)), 0, 0.1, "height after sliding");
  });
});

describe("the volume", () => {
  const FIELDS = 13;
  const gaussians = (...rows) => new space.Gaussians(rows.length, rows.length, new Float32Array(rows.flat()));
  const gaussian = (x, y, z, { intensity = 0.8, transmittance = 1, deviations = [2, 2, 2], q = [1, 0, 0, 0], label = 0 } = {}) => {
    const row = [x, y, z, intensity, transmittance, ...deviations, ...q, label];
    assert.equal(row.length, FIELDS);
    return row;
  };
  const grid = { low: [-10, -10, -10], voxel_mm: 0.5, size: [40, 40, 40] };
  const at = (volume, ...point) => [0, 1, 2, 3].map((channel) => space.byteAt(volume, ...point, channel));

  it("is the echo, coverage and shadow that docs/physics.md §3 gives", () => {
    const volume = space.voxelise(gaussians(gaussian(0.25, 0.25, 0.25, { intensity: 0.6, transmittance: 0.25, label: 3 })), grid);
    for (const away of [0, 1, 2, 4]) {
      const coverage = 1 - Math.exp(-Math.exp(-0.5 * (away / 2) ** 2));
      const [echo, covered, blocked, label] = at(volume, 0.3 + away, 0.3, 0.3);
      near(covered, 255 * coverage, 4, `coverage ${away} mm away`);
      near(echo, 255 * coverage * 0.6, 4, `echo ${away} mm away`);
      near(blocked, 255 * coverage * 0.75, 4, `what is blocked ${away} mm away`);
      assert.equal(label, 3);
    }
    assert.deepEqual(at(volume, 8, 8, 8), [0, 0, 0, 0]);
  });

  it("turns Gaussians as their quaternion says", () => {
    const half = Math.SQRT1_2;
    const volume = space.voxelise(gaussians(gaussian(0.25, 0.25, 0.25, { deviations: [3, 0.8, 0.8], q: [half, 0, 0, half] })), grid);
    assert.ok(at(volume, 0.3, 5, 0.3)[1] > 40 && at(volume, 5, 0.3, 0.3)[1] === 0, "the long axis x goes to y");
  });

  it("misses none that is thinner than a voxel, and counts those that were left out", () => {
    const thin = { deviations: [0.02, 2, 2] };
    const sum = (volume) => volume.voxels.reduce((all, byte, i) => all + (i % 4 === 1 ? byte : 0), 0);
    const sums = [0.25, 0.4, 0.5].map((x) => sum(space.voxelise(gaussians(gaussian(x, 0, 0, thin)), grid)));
    assert.ok(Math.min(...sums) > 0.8 * Math.max(...sums) && sums[0] > 0, `${sums}`);
    const one = gaussian(0, 0, 0, { deviations: [1, 1, 1] });
    const half = space.voxelise(new space.Gaussians(1, 2, new Float32Array(one)), grid);
    assert.ok(sum(half) > 1.4 * sum(space.voxelise(gaussians(one), grid)));
  });

  it("knows the labels of small things that let sound pass", () => {
    const small = { deviations: [0.7, 0.7, 0.7] };
    const rows = [
      gaussian(0, 0, 0, { label: 1, deviations: [4, 4, 4] }),
      gaussian(8, 0, 0, { label: 2, transmittance: 0.1, ...small }),
      gaussian(0, 8, 0, { label: 3, ...small }),
      gaussian(0, 0, 8, small),
    ];
    assert.deepEqual(space.smallLabels(space.voxelise(gaussians(...rows), grid)), [3]);
  });

  it("gives a voxel the label that most of what is there has", () => {
    const volume = space.voxelise(gaussians(gaussian(0, 0, 0, { label: 1 }), gaussian(0.1, 0, 0, { label: 2 }), gaussian(0, 0.1, 0, { label: 2 })), grid);
    assert.equal(at(volume, 0, 0, 0)[3], 2);
  });
});
