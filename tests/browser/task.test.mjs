/** The scores of a trainee's runs: what they count, and that their words mean what those of the gymnasium environment do. */

import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { test } from "node:test";

import { PYTHON, SOURCES } from "../console/harness.mjs";
import { built } from "../console/sources.mjs";

const { score, similarity } = await built("../../browser/src/task");
const { moved } = await built("../../browser/src/steering");

const HERE = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
const LINEAR = { kind: "linear", width_mm: 40, near_mm: 0, far_mm: 50 };
const near = (found, expected, within = 1e-9) => assert.ok(Math.abs(found - expected) <= within, `${found} is not ${expected}`);
/** A run along a function of time that tells the motion from HERE. */
const run = (seconds, motionAt, rate_hz = 30) =>
  Array.from({ length: seconds * rate_hz + 1 }, (_, k) => ({ time_s: k / rate_hz, pose: moved(HERE, motionAt(k / rate_hz)) }));
/** The smoothest reach of `mm` in `seconds`: minimum jerk. */
const reach = (mm, seconds) => (t) => ({ x: mm * (10 * (t / seconds) ** 3 - 15 * (t / seconds) ** 4 + 6 * (t / seconds) ** 5) });

test("a run is scored up to where the target was reached", () => {
  const there = moved(HERE, { x: 10 });
  const told = score({ probe: LINEAR, target: there }, run(4, (t) => ({ x: 5 * t })));
  assert.equal(told.reached, true);
  near(told.time_s, 1.8, 0.05); // 1 mm before it is near enough
  near(told.path_mm, 5 * told.time_s);
  assert.ok(told.distance_mm <= 1);
});

test("a target that is turned away is not reached, nor one that the probe does not touch", () => {
  const turned = score({ probe: LINEAR, target: moved(HERE, { tilt: 10 }) }, run(1, () => ({})));
  assert.equal(turned.reached, false);
  near(turned.angle_deg, 10, 1e-6);
  const moments = run(1, () => ({})).map((moment) => ({ ...moment, contact_share: 0.5, similarity: 0.25 }));
  const off = score({ probe: LINEAR, target: HERE }, moments);
  assert.deepEqual([off.reached, off.contact_share, off.reward], [false, 0.5, -1.25]);
});

test("a convex probe is where its face is, not where its fan begins", () => {
  const probe = { kind: "convex", opening_angle_deg: 60, near_mm: 40, far_mm: 90 };
  const about = moved(HERE, { tilt: 5 }, 40); // about the middle of the face
  near(score({ probe, target: about }, [{ time_s: 0, pose: HERE }]).distance_mm, 0, 1e-9);
  near(score({ probe: LINEAR, target: about }, [{ time_s: 0, pose: HERE }]).distance_mm, 40 * 2 * Math.sin((2.5 * Math.PI) / 180), 1e-6);
});

test("the smoothest reach has a smoothness of about −5, whatever its size, and stops make it less", () => {
  const far = { probe: LINEAR, target: moved(HERE, { y: 500 }) };
  for (const [mm, seconds] of [[20, 4], [80, 10]]) near(score(far, run(seconds, reach(mm, seconds))).smoothness, -5.32, 0.3);
  const stops = (t) => reach(20, 4)(t < 2 ? 1.3 * t : 2.6 + 0.7 * (t - 2));
  const halting = (t) => ({ x: reach(5, 1)(t % 1).x + 5 * Math.floor(t) });
  assert.ok(score(far, run(4, halting)).smoothness < score(far, run(4, stops)).smoothness);
  assert.equal(score(far, run(4, () => ({}))).smoothness, null);
});

test("a region is seen where the image passes over it", () => {
  const region = [0, 4, 8, 12].map((y) => [0, y, 20]).concat([[30, 0, 20]]);
  const far = moved(HERE, { z: 100 });
  near(score({ probe: LINEAR, target: far, region }, run(2, (t) => ({ y: 4 * t }))).coverage, 3 / 5);
  assert.equal(score({ probe: LINEAR, target: far, region: [] }, run(1, () => ({}))).coverage, null);
  const kinds = [
    [{ kind: "steered", width_mm: 40, steering_deg: 40, near_mm: 0, far_mm: 50 }, [30, 0, 20], [-19, 0, 20]],
    [{ kind: "phased", opening_angle_deg: 60, far_mm: 50 }, [11, 0, 20], [13, 0, 20]],
    [{ kind: "convex", opening_angle_deg: 60, near_mm: 10, far_mm: 50 }, [11, 0, 20], [1, 0, 5]],
    [{ kind: "radial", near_mm: 1, far_mm: 20 }, [0, 0, -19], [0, 0, 0.5]],
  ];
  for (const [probe, inside, outside] of kinds)
    assert.equal(score({ probe, target: far, region: [inside, outside] }, [{ time_s: 0, pose: HERE }]).coverage, 0.5, probe.kind);
});

test("frames are as alike as the gymnasium environment says", () => {
  const frame = (seed) => {
    const values = Uint8Array.from({ length: 48 * 64 }, (_, k) => (k * (seed + 3) + ((k * k) % (17 + seed))) % 251);
    return { info: { height: 48, width: 64 }, pixels: () => values };
  };
  const [one, other] = [frame(1), frame(2)];
  const program = `import json, sys
import torch
from ultragray_studies.gym.tasks import Target
one, other = (torch.tensor(values, dtype=torch.uint8).reshape(48, 64) for values in json.load(sys.stdin))
print(json.dumps(Target(one).similarity(torch.stack([other, one, one * 0])).tolist()))`;
  const environment = { ...process.env, PYTHONPATH: `${SOURCES}:studies`, OMP_NUM_THREADS: "1" };
  const input = JSON.stringify([one, other].map(({ pixels }) => [...pixels()]));
  const expected = JSON.parse(execFileSync(PYTHON, ["-c", program], { env: environment, input }));
  const black = { ...one, pixels: () => new Uint8Array(48 * 64) };
  [other, one, black].forEach((shown, at) => near(similarity(one, shown), expected[at], 1e-5));
});

test("a run that cannot be is refused in a sentence", () => {
  const task = { probe: LINEAR, target: HERE };
  assert.throws(() => score(task, []), /at least one moment, got none/);
  assert.throws(() => score(task, [{ time_s: 1, pose: HERE }, { time_s: 1, pose: HERE }]), /must rise from moment to moment/);
});
