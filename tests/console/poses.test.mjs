/** Files and texts of poses: web/src/geometry without a browser, and what the console says of what is wrong in them. */

import assert from "node:assert/strict";
import { describe, it } from "node:test";

import { bundled } from "./sources.mjs";

const {
  angle_deg, anglesFrom, distance_mm, english, fromPositionQuaternion, german, IDENTITY, POSE_FORMS, placeIn, poseFileOf, poseFromText,
  poseText, readPoses, REFERENCES, withPlaceIn, WRITTEN,
} = await bundled(`export * from "./geometry/pose"; export * from "./geometry/pose_files";
  import { english as all } from "./words/en/english"; import { german as texts } from "./words/de/german"; import { translated } from "./words/translated";
  export const english = all.connect; export const german = translated(all, texts).connect;`);

const TURNED = fromPositionQuaternion([12.5, -3, 40], [0.5, 0.5, -0.5, 0.5]);
const TILTED = fromPositionQuaternion([-1.25, 0, 0.5], [Math.cos(0.3), Math.sin(0.3), 0, 0]);
const bytes = (text) => new TextEncoder().encode(text).buffer;
const read = (name, text, chosen) => readPoses(name, typeof text === "string" ? bytes(text) : text, chosen);
const same = (a, b, most = 1e-3) => {
  assert.ok(distance_mm(a, b) < most, `${distance_mm(a, b)} mm apart`);
  assert.ok(angle_deg(a, b) < 0.01, `${angle_deg(a, b)}° apart`);
};
/** What the console says of a file that cannot be read. */
const refusal = (name, text, words = english) => {
  try {
    read(name, text);
  } catch (error) {
    return error.said(words.poseError);
  }
  return assert.fail("it was read");
};
const npy = (about, data) => {
  const header = Buffer.from(`${about}\n`, "latin1");
  const length = Buffer.alloc(2);
  length.writeUInt16LE(header.length);
  const whole = Buffer.concat([Buffer.from("\x93NUMPY\x01\x00", "latin1"), length, header, Buffer.from(data.buffer)]);
  return whole.buffer.slice(whole.byteOffset, whole.byteOffset + whole.length);
};
const PLUS = `ObjectType = Image
NDims = 3
Seq_Frame0000_ProbeToTrackerTransform = 1 0 0 10 0 1 0 20 0 0 1 30 0 0 0 1
Seq_Frame0000_ProbeToTrackerTransformStatus = OK
Seq_Frame0000_ImageToReferenceTransform = 0.1 0 0 1 0 0.1 0 2 0 0 0.1 3 0 0 0 1
Seq_Frame0000_ImageToReferenceTransformStatus = OK
Seq_Frame0000_ProbeToReferenceTransform = 1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1
Seq_Frame0000_ProbeToReferenceTransformStatus = OK
Seq_Frame0000_Timestamp = 1.5
Seq_Frame0001_ProbeToReferenceTransform = 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 1
Seq_Frame0001_ProbeToReferenceTransformStatus = INVALID
Seq_Frame0001_Timestamp = 1.6
Seq_Frame0002_ProbeToReferenceTransform = 1 0 0 4 0 1 0 5 0 0 1 6 0 0 0 1
Seq_Frame0002_ProbeToReferenceTransformStatus = OK
Seq_Frame0002_Timestamp = 1.7
ElementDataFile = LOCAL
Seq_Frame0003_ProbeToReferenceTransform = these are pixels`;

describe("a pose as text", () => {
  for (const form of POSE_FORMS)
    it(`comes back as it was: ${form}`, () => {
      for (const pose of [IDENTITY, TURNED, TILTED]) same(poseFromText(poseText(pose, form), form), pose, 2e-3);
    });
  it("is in metres for ROS, in either style of YAML", () => {
    assert.match(poseText(TURNED, "ros"), /position: \{x: 0\.0125, y: -0\.003, z: 0\.04\}/);
    const block = "pose:\n  orientation:\n    w: 1.0\n    x: 0\n    y: 0\n    z: 0\n  position:\n    x: 0.01\n    y: 0\n    z: -2e-3\n";
    same(poseFromText(block, "ros"), fromPositionQuaternion([10, 0, -2], [1, 0, 0, 0]));
  });
  it("is refused in words", () => {
    const said = (text, form) => {
      try {
        poseFromText(text, form);
      } catch (error) {
        return error.said(english.poseError);
      }
      return null;
    };
    assert.equal(said("1 2 3 1 0 0", "quaternion"), "6 numbers were found; 7 were expected.");
    assert.equal(said("1 2 3  1 1 0 0", "quaternion"), "The quaternion must have length 1; this one has 1.414.");
    assert.match(said("position: {x: 1, y: 2, z: 3}", "ros"), /orientation/);
    assert.match(said("2 0 0 0\n0 2 0 0\n0 0 2 0", "matrix"), /rotation/);
    assert.match(said("-1 0 0 0\n0 1 0 0\n0 0 1 0", "numpy"), /mirrors/);
  });
});

describe("a pose in a frame", () => {
  for (const reference of REFERENCES)
    it(`comes back as it was: ${reference}`, () => {
      const place = placeIn(TURNED, reference, TILTED);
      same(withPlaceIn(place, reference, TILTED), TURNED);
    });
  it("is zero against itself, and tells a step along the probe's own axis as one", () => {
    for (const reference of REFERENCES.slice(1)) {
      const { position_mm, angles_deg } = placeIn(TURNED, reference, TURNED);
      [...position_mm, ...angles_deg].forEach((value) => assert.ok(Math.abs(value) < 1e-6));
    }
    const { position_mm } = placeIn(fromPositionQuaternion([0, 1, 0], [1, 0, 0, 0]), "relativeProbe", fromPositionQuaternion([0, 0, 0], [Math.SQRT1_2, 0, 0, Math.SQRT1_2]));
    assert.deepEqual(position_mm.map((value) => Number(value.toFixed(6))), [1, 0, 0]);
    assert.deepEqual(anglesFrom(IDENTITY, placeIn && IDENTITY).map(Math.abs), [0, 0, 0]);
  });
});

describe("a file of poses", () => {
  for (const format of WRITTEN)
    it(`comes back as it was written: ${format}`, async () => {
      const file = poseFileOf([IDENTITY, TURNED, TILTED], [0, 0.5, 1.25], format);
      const back = read(`path.${format}`, await file.arrayBuffer());
      [IDENTITY, TURNED, TILTED].forEach((pose, index) => same(back.poses[index], pose, 2e-3));
      assert.deepEqual(back.times_s, format === "npy" ? null : [0, 0.5, 1.25]);
      assert.equal(back.unit, format === "tum" ? "m" : "mm");
    });

  it("of TUM is in metres, or in millimetres where somebody says so", () => {
    const text = "# timestamp tx ty tz qx qy qz qw\n1.5 0.01 0 -0.02 0 0 0 1\n";
    same(read("path.tum", text).poses[0], fromPositionQuaternion([10, 0, -20], [1, 0, 0, 0]));
    same(read("path.txt", text, { unit: "mm" }).poses[0], fromPositionQuaternion([0.01, 0, -0.02], [1, 0, 0, 0]));
  });

  it("of CSV takes its unit from its header, columns in any order", () => {
    const rows = "qw,qx,qy,qz,x_m,y_m,z_m\n1,0,0,0,0.001,0.002,0.003\n";
    const file = read("path.csv", rows);
    assert.deepEqual([file.unit, file.unitIsKnown, file.times_s], ["m", true, null]);
    same(file.poses[0], fromPositionQuaternion([1, 2, 3], [1, 0, 0, 0]));
    const plain = read("path.csv", "time;x;y;z;qw;qx;qy;qz\n0.25;1;2;3;1;0;0;0");
    assert.deepEqual([plain.unit, plain.unitIsKnown, plain.times_s], ["mm", false, [0.25]]);
    same(read("path.csv", "1,0,0,7,0,1,0,8,0,0,1,9").poses[0], fromPositionQuaternion([7, 8, 9], [1, 0, 0, 0]));
  });

  it("of NumPy may be float32, in Fortran's order, and of many shapes", () => {
    const identity = [1, 0, 0, 7, 0, 1, 0, 8, 0, 0, 1, 9, 0, 0, 0, 1];
    const expected = fromPositionQuaternion([7, 8, 9], [1, 0, 0, 0]);
    const shapes = [["(4, 4)", identity], ["(1, 4, 4)", identity], ["(1, 16)", identity], ["(1, 3, 4)", identity.slice(0, 12)]];
    for (const [shape, values] of shapes)
      same(read("a.npy", npy(`{'descr': '<f4', 'fortran_order': False, 'shape': ${shape}, }`, new Float32Array(values))).poses[0], expected);
    const columns = [0, 1, 2, 3].flatMap((column) => [0, 1, 2, 3].map((row) => identity[4 * row + column]));
    same(read("a.npy", npy("{'descr': '<f8', 'fortran_order': True, 'shape': (4, 4), }", new Float64Array(columns))).poses[0], expected);
  });

  it("of PLUS gives the probe's transform, leaves out what was not tracked, and offers the others", () => {
    const file = read("sweep.igs.mha", PLUS);
    assert.deepEqual([file.transform, file.transforms], ["ProbeToReference", ["ProbeToTracker", "ProbeToReference"]]);
    assert.deepEqual([file.poses.length, file.skipped, file.times_s], [2, 1, [1.5, 1.7]]);
    same(file.poses[1], fromPositionQuaternion([4, 5, 6], [1, 0, 0, 0]));
    const other = read("sweep.igs.mha", PLUS, { transform: "ProbeToTracker" });
    assert.deepEqual([other.poses.length, other.skipped], [1, 2]);
  });

  it("of ROS's kind in JSON is the service's own: objects or matrices", () => {
    same(read("a.json", '[{"matrix": [[1,0,0,7],[0,1,0,8],[0,0,1,9],[0,0,0,1]]}]').poses[0], fromPositionQuaternion([7, 8, 9], [1, 0, 0, 0]));
  });
});

describe("a file that cannot be read is refused in words that name the line and what was expected", () => {
  const WRONG = [
    ["a.tum", "0 1 2 3\n", "Line 1: 4 numbers were found; 8 were expected."],
    ["a.tum", "0 0 0 0 0 0 0 1\n1 0 0 x 0 0 0 1\n", "Line 2: “x” is not a number."],
    ["a.tum", "# nothing\n", "There are no poses in it."],
    ["a.csv", "x,y,z\n1,2,3\n", "Line 1: The columns qw, qx, qy, qz are missing."],
    ["a.csv", "x_mm,y_mm,z_mm,qw,qx,qy,qz\n1,2,3,1,0,0,0\n1,2,3,1\n", "Line 3: 4 numbers were found; 7 were expected."],
    ["a.csv", "1,2,3,1,0,0,0\n", "Line 1: The columns x_mm, y_mm, z_mm, qw, qx, qy, qz are missing."],
    ["a.npy", "not NumPy's at all", "This is not a file that NumPy wrote."],
    ["a.npy", npy("{'descr': '<i8', 'fortran_order': False, 'shape': (4, 4), }", new Float64Array(16)), "The numbers are of NumPy's type <i8; float32 or float64 was expected."],
    ["a.npy", npy("{'descr': '<f8', 'fortran_order': False, 'shape': (5, 7), }", new Float64Array(35)), "The array has the shape (5, 7); (N, 4, 4) was expected, also (N, 3, 4), (N, 12) or (N, 16)."],
    ["a.npy", npy("{'descr': '<f8', 'fortran_order': False, 'shape': (2, 4, 4), }", new Float64Array(16)), "The file ends before its last pose."],
    ["a.mha", "NDims = 3\nElementDataFile = LOCAL\n", "There are no transforms of frames in it (lines such as Seq_Frame0000_ProbeToReferenceTransform)."],
    ["a.json", "{", /^This is not JSON that the console knows/],
    ["a.json", '{"poses": [{"matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0]]}, {"matrix": [[2,0,0,0],[0,2,0,0],[0,0,2,0]]}]}', /^Pose 2: .*rotation/],
    ["a.doc", "", "Files of this kind (.doc) are not read. Read are: .json, .npy, .csv, .tum, .txt, .mha, .mhd."],
  ];
  for (const [name, text, expected] of WRONG)
    it(`${name}: ${expected}`, () => {
      const said = refusal(name, text);
      if (typeof expected === "string") assert.equal(said, expected);
      else assert.match(said, expected);
      assert.notEqual(refusal(name, text, german), said);
    });
});
