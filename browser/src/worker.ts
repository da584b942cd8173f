/** Renders in a thread of its own, so that the page never waits. It answers each request with its number. */

import { Crew } from "./crew.js";
import type { GpuRenderer } from "./gpu/renderer.js";
import { Library, type Extent, type Lines, type Rendered } from "./library.js";

/** What draws: WebGPU or WebAssembly; `auto`, the former where the browser has a GPU that suffices. */
export type RendererName = "wasm" | "webgpu";
export type RendererChoice = "auto" | RendererName;
/** The scene of this worker, of a whole file or of the beginning of one. */
export type LoadRequest = { act: "load"; module: WebAssembly.Module; bytes: Uint8Array; extent: Extent; renderer: RendererChoice; workers: number };
/** Views have numbers that who asks for them chooses. */
export type Request =
  | LoadRequest
  | { act: "prepare"; view: number; settings: string }
  | { act: "render"; view: number; pose: readonly number[] }
  | ({ act: "draw"; view: number; pose: readonly number[] } & Lines)
  | { act: "freeView"; view: number };
export type Answer = { number: number; result?: unknown; problem?: string };
export type Loaded = { info: string; renderer: RendererName };
export type Drawn = Rendered & { renderer: RendererName; workers: number };

let library: Library;
let scene: number;
let gpu: GpuRenderer | undefined;
let crew: Crew | undefined; // of more than this worker
const views = new Map<number, number>(); // in the library
let drawn: Promise<unknown> = Promise.resolve(); // when all frames that were asked for are there

async function load(request: LoadRequest): Promise<Loaded> {
  library = await Library.of(request.module);
  const loaded = library.load(request.bytes, request.extent);
  scene = loaded.scene;
  const isWhole = request.extent === "whole";
  if (request.renderer === "webgpu" || (request.renderer === "auto" && isWhole)) {
    try {
      const { GpuRenderer } = await import("./gpu/renderer.js"); // so that first frames do not wait for it
      gpu = await GpuRenderer.open(library, scene, { software: request.renderer === "webgpu" });
    } catch (error) {
      if (request.renderer === "webgpu") throw error;
    }
  }
  if (request.workers > 1 && isWhole) crew = new Crew(library, { ...request, renderer: "wasm" });
  return { info: loaded.info, renderer: gpu === undefined ? "wasm" : "webgpu" };
}

function prepare(view: number, settings: string): string {
  const prepared = library.prepare(scene, settings);
  views.set(view, prepared.view);
  crew?.prepare(view, settings);
  return prepared.info;
}

/** A frame, and what drew it: where the GPU fails, as a device that was lost, this worker draws, or says what is wrong. */
async function render(view: number, pose: readonly number[]): Promise<Drawn> {
  const at = views.get(view)!;
  try {
    const plan = gpu && library.plan(at, pose);
    if (gpu !== undefined && plan !== undefined && !plan.displaced) return { ...(await gpu.render(view, plan, (planes) => library.finish(at, pose, planes))), renderer: "webgpu", workers: 1 };
  } catch {
    if (gpu?.isLost) gpu = undefined;
  }
  const together = await crew?.render(view, at, pose);
  return { renderer: "wasm", workers: 1, ...(together ?? library.render(at, pose)) };
}

async function freeView(view: number): Promise<void> {
  await drawn; // some may be its own
  await gpu?.freeView(view);
  crew?.freeView(view);
  library.freeView(views.get(view)!);
  views.delete(view);
}

async function done(request: Request, transfer: Transferable[]): Promise<unknown> {
  switch (request.act) {
    case "load":
      return load(request);
    case "prepare":
      return prepare(request.view, request.settings);
    case "render": {
      const frame = render(request.view, request.pose);
      drawn = Promise.allSettled([drawn, frame]).then(() => undefined); // else each would keep all frames before it
      transfer.push((await frame).pixels.buffer);
      return frame;
    }
    case "draw": {
      const planes = library.draw(views.get(request.view)!, request.pose, request);
      transfer.push(planes.buffer);
      return planes;
    }
    case "freeView":
      return freeView(request.view);
  }
}

type Asked = { number: number; request: Request };

async function answer({ number, request }: Asked, asker: { postMessage(answer: Answer, options: StructuredSerializeOptions): void }): Promise<void> {
  const answer: Answer = { number };
  const transfer: Transferable[] = [];
  try {
    answer.result = await done(request, transfer);
  } catch (error) {
    answer.problem = error instanceof Error ? error.message : String(error);
  }
  asker.postMessage(answer, { transfer });
}

onmessage = ({ data }: MessageEvent<Asked | { port: MessagePort }>) => {
  if (!("port" in data)) return void answer(data, self);
  const { port } = data; // to the worker that this one helps
  port.onmessage = ({ data }: MessageEvent<Asked>) => void answer(data, port);
};
