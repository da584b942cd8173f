/** A worker that renders, and what is asked of it; its memory goes with it. */

import type { Answer, Request } from "./worker.js";

/** What a worker that draws asks of its page: helpers, each behind one of these ports, or the end of one of them. */
export type Wish = { helpers: MessagePort[] } | { dropped: number };

const started = (): Worker => new Worker(new URL("worker.js", import.meta.url), { type: "module" });

/** The asking side of a worker, or of a port behind which one is. */
export class Asker {
  #number = 0;
  #asked = new Map<number, { resolve: (result: unknown) => void; reject: (error: Error) => void }>();
  #ended: Error | undefined; // nothing answers any more

  constructor(private readonly port: Worker | MessagePort) {}

  ask<Result>(request: Request): Promise<Result> {
    return new Promise((resolve, reject) => {
      if (this.#ended !== undefined) return reject(this.#ended);
      this.#number += 1;
      this.#asked.set(this.#number, { resolve: resolve as (result: unknown) => void, reject });
      this.port.postMessage({ number: this.#number, request });
    });
  }

  take({ number, result, problem }: Answer): void {
    const asked = this.#asked.get(number);
    this.#asked.delete(number);
    if (problem === undefined) asked?.resolve(result);
    else asked?.reject(new Error(problem));
  }

  /** Rejects, with the error, what was asked and what will be. */
  end(error: Error): void {
    this.#ended = error;
    for (const { reject } of this.#asked.values()) reject(error);
    this.#asked.clear();
  }
}

/** A worker that renders, and its helpers. The page starts these, too: Firefox (153), under load, now and then blocks a worker for ever that starts another. */
export class Thread extends Asker {
  #helpers: Worker[] = [];

  constructor(private readonly worker = started()) {
    super(worker);
    worker.onmessage = ({ data }: MessageEvent<Answer | Wish>) => {
      if ("helpers" in data) this.#helpers = data.helpers.map(behind);
      else if ("dropped" in data) this.#helpers[data.dropped]!.terminate();
      else this.take(data);
    };
    worker.onerror = ({ message }) => this.end(new Error(`the renderer does not start: ${message}`));
  }

  close(): void {
    for (const worker of [this.worker, ...this.#helpers]) worker.terminate();
    this.end(new Error("the scene is closed"));
  }
}

/** A worker that answers what comes through a port. */
function behind(port: MessagePort): Worker {
  const worker = started();
  worker.postMessage({ port }, [port]);
  return worker;
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
