/** Renders in a thread of its own, so that the page never waits. It answers each request with its number. */

import { Library, type Extent } from "./library.js";

export type Request =
  | { act: "load"; bytes: Uint8Array; extent: Extent }
  | { act: "prepare"; scene: number; settings: string }
  | { act: "render"; view: number; pose: readonly number[] }
  | { act: "freeView"; view: number };
export type Answer = { number: number; result?: unknown; problem?: string };

let library: Promise<Library> | undefined;

async function open(): Promise<Library> {
  const answer = await fetch(new URL("ultragray.wasm", import.meta.url));
  if (!answer.ok) throw new Error(`the renderer, ${answer.url}, cannot be fetched: ${answer.status}`);
  return Library.of(await WebAssembly.compile(await answer.arrayBuffer()));
}

async function done(request: Request, transfer: Transferable[]): Promise<unknown> {
  library ??= open();
  const opened = await library;
  switch (request.act) {
    case "load":
      return opened.load(request.bytes, request.extent);
    case "prepare":
      return opened.prepare(request.scene, request.settings);
    case "render": {
      const frame = opened.render(request.view, request.pose);
      transfer.push(frame.pixels.buffer);
      return frame;
    }
    case "freeView":
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
