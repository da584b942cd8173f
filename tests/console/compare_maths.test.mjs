/** What Compare computes, without a browser: differences, similarity, correlation. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { built } from "./sources.mjs";

const { difference, similarity, valueAt, correlation, meanOf, underWay, worstFirst } = await built("compare/pictures");

const grey = (width, height, value) => ({
  width,
  height,
  values: Uint8Array.from({ length: width * height }, (_, i) => value(i % width, Math.floor(i / width))),
});

describe("pictures", () => {
  it("differ with a sign: brighter than the truth is positive", () => {
    const found = difference(grey(2, 1, () => 100), grey(2, 1, (x) => (x === 0 ? 130 : 60)));
    assert.deepEqual([...found], [30, -40]);
    assert.equal(difference(grey(2, 1, () => 0), grey(1, 2, () => 0)), null);
  });

  it("are as similar as the formula of SSIM says", () => {
    const noise = grey(32, 32, (x, y) => (x * 37 + y * 91 + x * y * 13) % 256);
    assert.ok(similarity(noise, noise).every((one) => Math.abs(one - 1) < 1e-4));
    // Two even pictures: no variance, and the means decide.
    const [a, b, c1] = [100, 150, (0.01 * 255) ** 2];
    const even = similarity(grey(16, 16, () => a), grey(16, 16, () => b));
    const expected = (2 * a * b + c1) / (a * a + b * b + c1);
    assert.ok(even.every((one) => Math.abs(one - expected) < 1e-3), `${even[0]} and not ${expected}`);
    const inverted = { ...noise, values: noise.values.map((value) => 255 - value) };
    assert.ok(similarity(noise, inverted).reduce((sum, one) => sum + one, 0) < 0, "opposites are alike");
  });

  it("tell the value under the pointer, and none beside", () => {
    const picture = grey(4, 2, (x, y) => 10 * x + y);
    assert.equal(valueAt(picture, 0.99, 0.99), 31);
    assert.equal(valueAt(picture, 1, 0.5), null);
    assert.equal(valueAt(picture, -0.01, 0.5), null);
  });
});

describe("statistics", () => {
  it("put the worst first, whichever way a metric is better", () => {
    const frames = [{ psnr_db: 20, gmsd: 0.2 }, { psnr_db: 30, gmsd: 0.1 }, { psnr_db: 10, gmsd: 0.3 }];
    assert.deepEqual(worstFirst(frames, "rendering", "psnr_db"), [2, 0, 1]);
    assert.deepEqual(worstFirst(frames, "rendering", "gmsd"), [2, 0, 1]);
  });

  it("leave out what is not measured yet", () => {
    const frame = (psnr_db, nearest_psnr_db) => ({ psnr_db, nearest_psnr_db, linear_psnr_db: 1, median_psnr_db: 1 });
    const frames = [frame(20, 10), frame(null, null), frame(10, null)];
    assert.equal(meanOf(frames, "rendering", "psnr_db"), 15);
    assert.equal(meanOf([frame(null, null)], "rendering", "psnr_db"), null);
    assert.deepEqual(worstFirst(frames, "rendering", "psnr_db"), [2, 0, 1]);
    assert.deepEqual(underWay(frames), { way: "rendering", done: 2 });
    assert.deepEqual(underWay([frame(1, 2), frame(1, null)]), { way: "nearest", done: 1 });
    assert.equal(underWay([frame(1, 2)]), null);
  });

  it("correlate as Pearson does", () => {
    assert.ok(Math.abs(correlation([[1, 2], [2, 4], [3, 6]]) - 1) < 1e-12);
    assert.ok(Math.abs(correlation([[1, 1], [2, 3], [3, 2]]) - 0.5) < 1e-12);
    assert.equal(correlation([[1, 1], [1, 3], [1, 2]]), null);
    assert.equal(correlation([[1, 1], [2, 3]]), null);
  });
});
