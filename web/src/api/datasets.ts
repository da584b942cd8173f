/** Data sets: uploaded, checked, looked at. */

import { address, getJson, keyHeaders, postJson, refusalOf, remove, type Schemas, Unreachable } from "./client";

/** Shares of the body that were sent, 0 to 1; 1 while the service checks what it got. */
export type Told = (share: number) => void;

/** PUTs a body. Throws ServiceError for a status of 400 and above, Unreachable, AbortError. */
export function putFile<T>(path: string, body: Blob | FormData, told: Told, signal: AbortSignal): Promise<T> {
  return new Promise<T>((resolve, reject) => {
    const sending = new XMLHttpRequest();
    sending.open("PUT", path);
    for (const [name, value] of Object.entries(keyHeaders())) sending.setRequestHeader(name, value);
    if (body instanceof Blob) sending.setRequestHeader("Content-Type", body.type || "application/octet-stream");
    sending.upload.onprogress = (event) => told(event.lengthComputable ? event.loaded / event.total : 0);
    sending.upload.onload = () => told(1);
    sending.onerror = () => reject(new Unreachable());
    sending.onabort = () => reject(new DOMException("The upload was stopped.", "AbortError"));
    sending.onload = () => {
      if (sending.status < 400) return resolve(JSON.parse(sending.responseText) as T);
      const answer = new Response(sending.responseText, { status: sending.status, statusText: sending.statusText });
      void refusalOf(answer).then(reject);
    };
    signal.addEventListener("abort", () => sending.abort());
    sending.send(body);
  });
}

export type Dataset = Schemas["DatasetRecord"];
export type DatasetPoses = Schemas["DatasetPoses"];
export type Part = keyof DatasetPoses;
/** How an upload is read; what is empty is left as it is stored. */
export type DatasetOptions = Record<string, string>;

const ARCHIVES = [".zip", ".tar", ".tgz", ".gz"];

export async function listDatasets(): Promise<Dataset[]> {
  return (await getJson("/v1/datasets", {}, { query: { page_size: "1000" } })).datasets;
}

/** One archive is sent as it is, files as a form; others do not see a private dataset. Throws what `putFile` throws. */
export function uploadDataset(
  dataset: string,
  files: File[],
  options: DatasetOptions,
  isPrivate: boolean,
  told: Told,
  signal: AbortSignal,
): Promise<Dataset> {
  const given = new URLSearchParams(Object.entries(options).filter(([, value]) => value !== ""));
  if (isPrivate) given.set("private", "true");
  const path = `${address("/v1/datasets/{dataset}", { dataset })}?${given}`;
  const [first] = files;
  if (files.length === 1 && first && ARCHIVES.some((suffix) => first.name.toLowerCase().endsWith(suffix)))
    return putFile(path, new Blob([first], { type: "application/octet-stream" }), told, signal);
  const form = new FormData();
  for (const file of files) form.append("files", file, file.webkitRelativePath || file.name);
  return putFile(path, form, told, signal);
}

/** Has the service simulate a sweep over its built-in phantom, in about half a minute. */
export const simulateDataset = (dataset: string): Promise<Dataset> => postJson("/v1/datasets/{dataset}:simulate", { dataset });

export function datasetPoses(dataset: string, signal: AbortSignal): Promise<DatasetPoses> {
  return getJson("/v1/datasets/{dataset}/poses", { dataset }, { signal });
}

export function framePath(dataset: string, part: Part, index: number): string {
  return address("/v1/datasets/{dataset}/frames/{part}/{index}", { dataset, part, index });
}

export const contactSheetPath = (dataset: string): string => address("/v1/datasets/{dataset}/contact-sheet", { dataset });

export const deleteDataset = (dataset: string): Promise<void> => remove("/v1/datasets/{dataset}", { dataset });
