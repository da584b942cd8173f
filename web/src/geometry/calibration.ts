/** What a calibration from pixels to millimetres says, for people to check. */

const DEGREES = 180 / Math.PI;

export interface Calibration {
  /** Which way columns and rows of the image run: 0 to 5 are +x, +y, +z, −x, −y, −z of the probe. */
  column: number;
  row: number;
  /** Where the first pixel lies, mm along x and z (or the axis of the rows). */
  across_mm: number;
  deep_mm: number;
  /** Between columns and rows. */
  angle_deg: number;
}

/** Reads a matrix [4, 4], row by row. */
export function readCalibration(matrix: readonly number[]): Calibration {
  const column = [0, 4, 8].map((at) => matrix[at]!);
  const row = [1, 5, 9].map((at) => matrix[at]!);
  const origin = [3, 7, 11].map((at) => matrix[at]!);
  const along = (axis: readonly number[]): number => dot(origin, axis) / length(axis);
  return {
    column: directionOf(column),
    row: directionOf(row),
    across_mm: along(column),
    deep_mm: along(row),
    angle_deg: Math.acos(Math.max(-1, Math.min(1, dot(column, row) / (length(column) * length(row))))) * DEGREES,
  };
}

function directionOf(vector: readonly number[]): number {
  const axis = vector.reduce((best, value, at) => (Math.abs(value) > Math.abs(vector[best]!) ? at : best), 0);
  return axis + (vector[axis]! < 0 ? 3 : 0);
}

function dot(one: readonly number[], other: readonly number[]): number {
  return one.reduce((sum, value, at) => sum + value * other[at]!, 0);
}

function length(vector: readonly number[]): number {
  return Math.sqrt(dot(vector, vector));
}
