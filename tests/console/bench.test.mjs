/** What Train works out without a browser: crops, sequences on the person's disk, the scales of charts, settings. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";
import { deflateSync, gzipSync } from "node:zlib";

import { built } from "./sources.mjs";

const { between, holds, moved, readEdges, whole, writeCrop, Sequence, rangeOf, ticks, tickText, readCalibration } = await built("train/sweeps.svelte", "shared/chart");

const SIZE = { width: 640, height: 480 };

describe("a crop", () => {
  it("is written and read as the service does", () => {
    assert.equal(writeCrop({ left: 188, right: 632, top: 12, bottom: 400 }), "188:632,12:400");
    const readCrop = (text, size) => [readEdges(text, size)].find((crop) => crop !== null && holds(crop, size)) ?? null;
    assert.deepEqual(readCrop(" 188:632 , 12:400 ", SIZE), { left: 188, right: 632, top: 12, bottom: 400 });
    assert.deepEqual(readCrop(":,10:", SIZE), { left: 0, right: 640, top: 10, bottom: 480 });
    for (const wrong of ["", "188:632", "632:188,0:10", "0:641,0:10", "a:b,c:d", "5:5,0:10"]) assert.equal(readCrop(wrong, SIZE), null, wrong);
  });

  it("is drawn from any corner, within the image, at least a pixel wide", () => {
    assert.deepEqual(between({ x: 300.6, y: 200.2 }, { x: 100.2, y: -50 }, SIZE), { left: 100, right: 301, top: 0, bottom: 201 });
    assert.deepEqual(between({ x: 700, y: 500 }, { x: 700, y: 500 }, SIZE), { left: 639, right: 640, top: 479, bottom: 480 });
  });

  it("moves as a whole without changing its size, and its edges do not cross", () => {
    const crop = { left: 10, right: 110, top: 20, bottom: 70 };
    assert.deepEqual(moved(crop, ["left", "right", "top", "bottom"], -50, 5, SIZE), { left: 0, right: 100, top: 25, bottom: 75 });
    assert.equal(moved(crop, ["left"], 500, 0, SIZE).left, 109);
    assert.equal(moved(crop, ["bottom"], 0, -500, SIZE).bottom, 21);
    assert.deepEqual(moved(whole(SIZE), ["right"], 5, 5, SIZE), whole(SIZE));
  });
});

describe("a sequence on the disk", () => {
  const [columns, rows, frames] = [5, 3, 4];
  const pixels = Uint8Array.from({ length: columns * rows * frames }, (_, i) => i);
  const meta = (more = "", size = `${columns} ${rows} ${frames}`) =>
    `ObjectType = Image\nNDims = 3\nDimSize = ${size}\nElementType = MET_UCHAR\n${more}Seq_Frame0000_ProbeToTrackerTransform = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n`;
  const frameOf = (number) => [...pixels.slice(number * columns * rows, (number + 1) * columns * rows)];
  const grey = async (files, number) => [...(await (await Sequence.among(files)).frame(number)).grey];

  it("is read from MetaImage, plain, compressed, and with its pixels beside it", async () => {
    const plain = new File([meta(), "ElementDataFile = LOCAL\n", pixels], "sweep.igs.mha");
    const packed = new File([meta("CompressedData = True\n"), "ElementDataFile = LOCAL\n", deflateSync(pixels)], "sweep.mha");
    const beside = [new File([meta(), "ElementDataFile = sweep.raw\n"], "sweep.mhd"), new File([pixels], "sweep.raw")];
    for (const files of [[plain], [packed], beside]) {
      assert.equal((await Sequence.among(files)).frames, frames);
      for (const number of [0, 3]) assert.deepEqual(await grey(files, number), frameOf(number));
    }
  });

  it("is read from NRRD, with colours as their luma", async () => {
    const header = (encoding) => `NRRD0005\ntype: uchar\ndimension: 3\nsizes: ${columns} ${rows} ${frames}\nkinds: domain domain list\nencoding: ${encoding}\n\n`;
    assert.deepEqual(await grey([new File([header("gzip"), gzipSync(pixels)], "sweep.seq.nrrd")], 2), frameOf(2));
    assert.deepEqual(await grey([new File([header("raw"), pixels], "sweep.nrrd")], 1), frameOf(1));
    const coloured = new File(["NRRD0005\ntype: uint8\nsizes: 3 1 1 1\nkinds: RGB-color domain domain list\nencoding: raw\n\n", Uint8Array.of(255, 0, 0)], "red.nrrd");
    assert.deepEqual(await grey([coloured], 0), [76]);
  });

  it("is brought to columns lateral and rows in depth", async () => {
    const stored = (orientation) => new File([meta(`UltrasoundImageOrientation = ${orientation}\n`), "ElementDataFile = LOCAL\n", pixels], "a.mha");
    const one = await (await Sequence.among([stored("UN")])).frame(0);
    assert.deepEqual([...one.grey], frameOf(0).reverse());
    const turned = await (await Sequence.among([stored("FM")])).frame(0);
    assert.deepEqual([turned.width, turned.height], [rows, columns]);
    assert.deepEqual([...turned.grey.slice(0, 4)], [0, 5, 10, 1]);
  });

  it("is none where it cannot be shown", async () => {
    assert.equal(await Sequence.among([new File(["x"], "cine.dcm")]), null);
    assert.equal(await Sequence.among([new File([meta().replace("UCHAR", "SHORT"), "ElementDataFile = LOCAL\n"], "a.mha")]), null);
    assert.equal(await Sequence.among([new File(["no header at all"], "a.mha")]), null);
  });
});

describe("the ticks of a chart", () => {
  it("are round, whole where steps are, and as many as have room", () => {
    assert.deepEqual(ticks({ low: 1, high: 60 }, 5), [20, 40, 60]);
    assert.deepEqual(ticks({ low: 1, high: 3 }, 8, true), [1, 2, 3]); // there is no step 1.5
    assert.deepEqual(ticks({ low: 0, high: 0.3 }, 3), [0, 0.1, 0.2, 0.3]); // and not 0.30000000000000004
    assert.ok(ticks({ low: 0, high: 97_000 }, 4).length <= 5);
  });

  it("are written alike, and shortly", () => {
    const written = (...values) => values.map(tickText(values));
    assert.deepEqual(written(19.5, 20, 20.5), ["19.5", "20.0", "20.5"]);
    assert.deepEqual(written(0, 50_000, 100_000), ["0", "50k", "100k"]);
    assert.deepEqual(written(0.0005, 0.001), ["0.0005", "0.0010"]);
    assert.deepEqual(written(0, 1000, 2000), ["0", "1,000", "2,000"]);
  });

  it("leave room around what is flat or begins at zero", () => {
    assert.deepEqual(rangeOf([3, 3]), { low: 2.5, high: 3.5 });
    assert.deepEqual(rangeOf([0, 0], { fromZero: true }), { low: 0, high: 1 });
    assert.deepEqual(rangeOf([1, 5], { margin: false }), { low: 1, high: 5 });
    assert.deepEqual(rangeOf([]), { low: 0, high: 1 });
  });
});

describe("a calibration", () => {
  it("says which way the image runs, and where its first pixel lies", () => {
    const found = readCalibration([0.1, 0, 0, -20, 0, 0, 1, 0, 0, -0.2, 0, 5, 0, 0, 0, 1]);
    assert.deepEqual([found.column, found.row], [0, 5]); // +x, −z
    assert.ok(Math.abs(found.across_mm + 20) < 1e-9 && Math.abs(found.deep_mm + 5) < 1e-9);
    assert.ok(Math.abs(found.angle_deg - 90) < 1e-9);
  });
});
