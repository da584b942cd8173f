/** The Gaussians of a scene as the service tells of them; workers read this too. */

/** What is asked of each Gaussian: mm in the scene's frame; the quaternion turns its own axes into the scene's. */
export const FIELDS = [
  "x", "y", "z", "intensity", "transmittance", "deviation_1_mm", "deviation_2_mm", "deviation_3_mm",
  "qw", "qx", "qy", "qz", "label",
] as const; // prettier-ignore
type Field = (typeof FIELDS)[number];

/** Some of the Gaussians of a scene. */
export class Gaussians {
  constructor(
    readonly count: number,
    /** Of the scene. */
    readonly total: number,
    /** One after another, `FIELDS` of each. */
    readonly values: Float32Array<ArrayBuffer>,
  ) {}

  /** One field of all of them, as an array of its own. */
  column(field: Field): Float32Array<ArrayBuffer> {
    const column = new Float32Array(this.count);
    const first = FIELDS.indexOf(field);
    for (let i = 0; i < this.count; i++) column[i] = this.values[i * FIELDS.length + first]!;
    return column;
  }
}
