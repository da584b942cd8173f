/** A PLUS sequence as the tests upload it: speckle in a frame of rulers and texts, tracked, with its calibration. */

const COLUMNS = 96;
const ROWS = 72;
const FRAMES = 10;
/** Where the ultrasound is. */
export const REGION = { left: 16, right: 80, top: 8, bottom: 64 };
const PIXEL_MM = 0.5;

export function makeSequence() {
  const pixels = Buffer.alloc(COLUMNS * ROWS * FRAMES, 8);
  let random = 1;
  for (let frame = 0; frame < FRAMES; frame++)
    for (let row = REGION.top; row < REGION.bottom; row++)
      for (let column = REGION.left; column < REGION.right; column++) {
        random = (Math.imul(random, 1103515245) + 12345) >>> 0;
        const vessel = Math.hypot(column - 46 - frame, row - 34) < 9 ? 0.2 : 1;
        pixels[(frame * ROWS + row) * COLUMNS + column] = vessel * (90 + ((random >>> 16) % 90));
      }
  const identity = (y) => `1 0 0 0 0 1 0 ${y} 0 0 1 0 0 0 0 1`;
  const toProbe = `${PIXEL_MM} 0 0 ${-0.5 * PIXEL_MM * COLUMNS} 0 0 1 0 0 ${PIXEL_MM} 0 0 0 0 0 1`;
  const fields = Array.from({ length: FRAMES }, (_, frame) => {
    const name = `Seq_Frame${String(frame).padStart(4, "0")}_`;
    return [
      `${name}ProbeToTrackerTransform = ${identity(frame)}`,
      `${name}ProbeToTrackerTransformStatus = OK`,
      `${name}ImageToProbeTransform = ${toProbe}`,
      `${name}ImageToProbeTransformStatus = OK`,
      `${name}ImageStatus = OK`,
    ].join("\n");
  });
  const header = `ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = False\nDimSize = ${COLUMNS} ${ROWS} ${FRAMES}\nElementType = MET_UCHAR\nUltrasoundImageOrientation = MF\nUltrasoundImageType = BRIGHTNESS\n${fields.join("\n")}\nElementDataFile = LOCAL\n`;
  return { name: "neck.igs.mha", mimeType: "application/octet-stream", buffer: Buffer.concat([Buffer.from(header), pixels]) };
}
