/** Gaussians as points, coloured by what they reflect or by what they let through. */

import { BufferAttribute, BufferGeometry, Points, PointsMaterial, type Plane } from "three";

import type { GaussianPoints } from "../api/scenes";
import { ramp } from "../shared/colours";

export type PointColour = "intensity" | "transmittance";

const FIELDS = 6; // x, y, z, intensity, transmittance, mean standard deviation
const FIELD_OF: Record<PointColour, number> = { intensity: 3, transmittance: 4 };

export class PointCloud {
  readonly object: Points<BufferGeometry, PointsMaterial>;
  #values: Float32Array;
  #colours: Uint8Array;

  /** `cut` leaves out what lies behind it. */
  constructor({ count, values }: GaussianPoints, cut: Plane) {
    this.#values = values;
    this.#colours = new Uint8Array(count * 3);
    const positions = new Float32Array(count * 3);
    for (let i = 0; i < count; i++) positions.set(values.subarray(i * FIELDS, i * FIELDS + 3), i * 3);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(positions, 3));
    geometry.setAttribute("color", new BufferAttribute(this.#colours, 3, true));
    const material = new PointsMaterial({ size: 1.6, sizeAttenuation: false, vertexColors: true });
    material.clippingPlanes = [cut];
    this.object = new Points(geometry, material);
    this.colourBy("intensity");
  }

  /** Spreads the colours over the middle 96 % of the values. */
  colourBy(colour: PointColour): void {
    const field = FIELD_OF[colour];
    const count = this.#colours.length / 3;
    const values = new Float32Array(count);
    for (let i = 0; i < count; i++) values[i] = this.#values[i * FIELDS + field]!;
    const sorted = values.slice().sort();
    const low = sorted[Math.floor(count * 0.02)] ?? 0;
    const range = (sorted[Math.floor(count * 0.98)] ?? 1) - low || 1;
    for (let i = 0; i < count; i++) {
      const share = Math.max(0, Math.min(1, (values[i]! - low) / range));
      this.#colours.set(ramp(colour, share), i * 3);
    }
    this.object.geometry.attributes.color!.needsUpdate = true;
  }

  dispose(): void {
    this.object.geometry.dispose();
    this.object.material.dispose();
  }
}
