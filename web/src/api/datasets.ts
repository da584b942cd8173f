/** Datasets: uploaded, checked, looked at. */

import { getJson, request, segment } from "./client";
import type { Probe } from "./scenes";
import { putFile, type Told } from "./upload";

export interface Dataset {
  name: string;
  kind: "released" | "plus";
  sha256: string;
  bytes: number;
  created_at: string;
  train_frames: number;
  val_frames: number;
  height: number;
  width: number;
  probe: Probe | null;
  warnings: string[];
  options: Record<string, string>;
}

/** How an upload is read; what is empty is left as it is stored. */
export interface DatasetOptions {
  crop: string;
  image_size: string;
  frames: string;
  train_frames: string;
  val_frames: string;
}

export interface DatasetPoses {
  train: number[][];
  val: number[][];
}

export type Part = keyof DatasetPoses;

const ARCHIVES = [".zip", ".tar", ".tgz", ".gz"];

export async function listDatasets(): Promise<Dataset[]> {
  return (await getJson<{ datasets: Dataset[] }>("/v1/datasets?page_size=1000")).datasets;
}

/** One archive is sent as it is, files as a form. Throws what `putFile` throws. */
export function uploadDataset(
  name: string,
  files: File[],
  options: DatasetOptions,
  told: Told,
  signal: AbortSignal,
): Promise<Dataset> {
  const given = new URLSearchParams(Object.entries(options).filter(([, value]) => value !== ""));
  const path = `/v1/datasets/${segment(name)}?${given}`;
  const [first] = files;
  if (files.length === 1 && first && ARCHIVES.some((suffix) => first.name.toLowerCase().endsWith(suffix)))
    return putFile(path, new Blob([first], { type: "application/octet-stream" }), told, signal);
  const form = new FormData();
  for (const file of files) form.append("files", file, file.webkitRelativePath || file.name);
  return putFile(path, form, told, signal);
}

export function datasetPoses(dataset: string, signal: AbortSignal): Promise<DatasetPoses> {
  return getJson(`/v1/datasets/${segment(dataset)}/poses`, signal);
}

export function framePath(dataset: string, part: Part, index: number): string {
  return `/v1/datasets/${segment(dataset)}/frames/${part}/${index}`;
}

export function contactSheetPath(dataset: string): string {
  return `/v1/datasets/${segment(dataset)}/contact-sheet`;
}

export async function deleteDataset(dataset: string): Promise<void> {
  await request(`/v1/datasets/${segment(dataset)}`, { method: "DELETE" });
}
