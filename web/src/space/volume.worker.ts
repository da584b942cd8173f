/** Adds Gaussians up to a volume beside the page: coarsely at once, then as finely as there is time for. */

import { Gaussians } from "../api/gaussians";
import { gridAround, type Volume, voxelise, workOf } from "./volume";

export interface VolumeOrder {
  count: number;
  total: number;
  values: Float32Array<ArrayBuffer>;
  /** That the fine volume may take, about. */
  budget_ms: number;
  mostVoxels: number;
}
export interface VolumeDelivery {
  volume: Volume;
  isLast: boolean;
}

const COARSE_MM = 2.5;
const FINEST_MM = 0.5;
const STEP = 1.15; // from one size of voxels to the next

const send = (volume: Volume, isLast: boolean): void => {
  const delivery: VolumeDelivery = { volume, isLast };
  postMessage(delivery, { transfer: [volume.voxels.buffer] });
};

addEventListener("message", ({ data }: MessageEvent<VolumeOrder>) => {
  const gaussians = new Gaussians(data.count, data.total, data.values);
  const begin = performance.now();
  const coarse = voxelise(gaussians, gridAround(gaussians, COARSE_MM));
  const cost_ms = (performance.now() - begin) / workOf(gaussians, COARSE_MM);
  send(coarse, false);
  let voxel_mm = COARSE_MM;
  for (let finer = voxel_mm / STEP; finer >= FINEST_MM; finer /= STEP) {
    const [x, y, z] = gridAround(gaussians, finer).size;
    if (x * y * z > data.mostVoxels || workOf(gaussians, finer) * cost_ms > data.budget_ms) break;
    voxel_mm = finer;
  }
  send(voxelise(gaussians, gridAround(gaussians, voxel_mm)), true);
});
