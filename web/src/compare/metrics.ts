/** The metrics of images as people read them. */

import type { Metric } from "../api/comparison";

export const LABELS: Record<Metric, { title: string; unit: string; digits: number; better: string }> = {
  psnr_db: { title: "PSNR", unit: "dB", digits: 2, better: "higher is better" },
  ms_ssim: { title: "MS-SSIM", unit: "", digits: 3, better: "higher is better" },
  gms: { title: "GMS", unit: "", digits: 3, better: "higher is better" },
  gmsd: { title: "GMSD", unit: "", digits: 3, better: "lower is better" },
  histogram_distance: { title: "Histogram distance", unit: "", digits: 4, better: "lower is better" },
};
export const METRICS = Object.keys(LABELS) as Metric[];

/** Title and unit of a metric. */
export function metricLabel(metric: Metric): string {
  const { title, unit } = LABELS[metric];
  return unit === "" ? title : `${title}, ${unit}`;
}
