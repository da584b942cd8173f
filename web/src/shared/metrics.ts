/** The metrics of images: their names, units and digits. */

import type { Metric } from "../api/comparison";

export const LABELS: Record<Metric, { title: string; unit: string; digits: number; higherIsBetter: boolean }> = {
  psnr_db: { title: "PSNR", unit: "dB", digits: 2, higherIsBetter: true },
  ms_ssim: { title: "MS-SSIM", unit: "", digits: 3, higherIsBetter: true },
  gms: { title: "GMS", unit: "", digits: 3, higherIsBetter: true },
  gmsd: { title: "GMSD", unit: "", digits: 3, higherIsBetter: false },
  histogram_distance: { title: "Histogram distance", unit: "", digits: 4, higherIsBetter: false },
};
export const METRICS = Object.keys(LABELS) as Metric[];
