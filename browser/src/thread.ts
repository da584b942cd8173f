/** A worker that renders, and what is asked of it; its memory goes with it. */

import type { Answer, Request } from "./worker.js";

export class Thread {
  #worker = new Worker(new URL("worker.js", import.meta.url), { type: "module" });
  #number = 0;
  #asked = new Map<number, { resolve: (result: unknown) => void; reject: (error: Error) => void }>();

  constructor() {
    this.#worker.onmessage = ({ data: { number, result, problem } }: MessageEvent<Answer>) => {
      const asked = this.#asked.get(number);
      this.#asked.delete(number);
      if (problem === undefined) asked?.resolve(result);
      else asked?.reject(new Error(problem));
    };
    this.#worker.onerror = ({ message }) => this.#end(new Error(`the renderer does not start: ${message}`));
  }

  ask<Result>(request: Request): Promise<Result> {
    return new Promise((resolve, reject) => {
      this.#number += 1;
      this.#asked.set(this.#number, { resolve: resolve as (result: unknown) => void, reject });
      this.#worker.postMessage({ number: this.#number, request });
    });
  }

  close(): void {
    this.#worker.terminate();
    this.#end(new Error("the scene is closed"));
  }

  #end(error: Error): void {
    for (const { reject } of this.#asked.values()) reject(error);
    this.#asked.clear();
  }
}

let module: Promise<WebAssembly.Module> | undefined;

/** The renderer, which is compiled once for all workers of a page. */
export function compiled(): Promise<WebAssembly.Module> {
  module ??= compile();
  module.catch(() => (module = undefined)); // the next scene tries again
  return module;
}

async function compile(): Promise<WebAssembly.Module> {
  const answer = await fetch(new URL("ultragray.wasm", import.meta.url));
  if (!answer.ok) throw new Error(`the renderer, ${answer.url}, cannot be fetched: ${answer.status}`);
  return WebAssembly.compile(await answer.arrayBuffer());
}
