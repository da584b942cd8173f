/** Renders in a thread of its own, so that the page never waits. It answers each request with its number. */

import { GpuRenderer } from "./gpu/renderer.js";
import { Library, type Extent, type Rendered } from "./library.js";

/** What draws: WebGPU or WebAssembly; `auto`, the former where the browser has a GPU that suffices. */
export type RendererName = "wasm" | "webgpu";
export type RendererChoice = "auto" | RendererName;
export type Request =
  | { act: "load"; bytes: Uint8Array; extent: Extent; renderer: RendererChoice }
  | { act: "prepare"; scene: number; settings: string }
  | { act: "render"; view: number; pose: readonly number[] }
  | { act: "freeView"; view: number };
export type Answer = { number: number; result?: unknown; problem?: string };
export type Loaded = { scene: number; info: string; renderer: RendererName };
export type Drawn = Rendered & { renderer: RendererName };

let library: Promise<Library> | undefined;
let gpu: GpuRenderer | undefined;
let drawn: Promise<unknown> = Promise.resolve(); // when all frames that were asked for are there

async function open(): Promise<Library> {
  const answer = await fetch(new URL("ultragray.wasm", import.meta.url));
  if (!answer.ok) throw new Error(`the renderer, ${answer.url}, cannot be fetched: ${answer.status}`);
  return Library.of(await WebAssembly.compile(await answer.arrayBuffer()));
}

async function load(opened: Library, { bytes, extent, renderer }: Extract<Request, { act: "load" }>): Promise<Loaded> {
  const loaded = opened.load(bytes, extent);
  if (renderer !== "wasm") {
    try {
      gpu = await GpuRenderer.open(opened, loaded.scene, { software: renderer === "webgpu" });
    } catch (error) {
      if (renderer === "webgpu") throw error;
    }
  }
  return { ...loaded, renderer: gpu === undefined ? "wasm" : "webgpu" };
}

/** A frame, and what drew it: where the GPU fails, as for a device that was lost, WebAssembly draws, or says what is wrong. */
async function render(opened: Library, view: number, pose: readonly number[]): Promise<Drawn> {
  if (gpu !== undefined) {
    try {
      const frame = await gpu.render(view, opened.plan(view, pose), (planes) => opened.finish(view, pose, planes));
      return { ...frame, renderer: "webgpu" };
    } catch {
      if (gpu?.isLost) gpu = undefined;
    }
  }
  return { ...opened.render(view, pose), renderer: "wasm" };
}

async function done(request: Request, transfer: Transferable[]): Promise<unknown> {
  library ??= open();
  const opened = await library;
  switch (request.act) {
    case "load":
      return load(opened, request);
    case "prepare":
      return opened.prepare(request.scene, request.settings);
    case "render": {
      const frame = render(opened, request.view, request.pose);
      drawn = Promise.allSettled([drawn, frame]).then(() => undefined); // else each would keep all frames before it
      transfer.push((await frame).pixels.buffer);
      return frame;
    }
    case "freeView":
      await drawn; // some may be its own
      await gpu?.freeView(request.view);
      return opened.freeView(request.view);
  }
}

onmessage = async ({ data: { number, request } }: MessageEvent<{ number: number; request: Request }>) => {
  const answer: Answer = { number };
  const transfer: Transferable[] = [];
  try {
    answer.result = await done(request, transfer);
  } catch (error) {
    answer.problem = error instanceof Error ? error.message : String(error);
  }
  postMessage(answer, { transfer });
};
