/** What takes time: values that follow others calmly, answers that are asked for again and again, files that are sent and kept. */

import { SvelteSet } from "svelte/reactivity";

import { explain, pauseAfter, ServiceError } from "../api/client";
import type { Told } from "../api/datasets";
import type { ViewName } from "../page/router.svelte";

const EVERY_MS = 125;

/** A value for reading: it follows another at most a few times a second, so that live images leave time to draw. */
export class Calm<T> {
  value: T = $state.raw() as T;
  #latest: T;
  #timer: ReturnType<typeof setTimeout> | undefined;
  #shown_ms = -Infinity;

  /** Follows `read`. Must be made while a component is being made; ends with it. */
  constructor(read: () => T) {
    this.value = this.#latest = read();
    $effect(() => {
      this.#latest = read();
      if (this.#timer !== undefined) return;
      const wait = this.#shown_ms + EVERY_MS - performance.now();
      if (wait <= 0) this.#show();
      else this.#timer = setTimeout(() => this.#show(), wait);
    });
    $effect(() => () => clearTimeout(this.#timer));
  }

  #show(): void {
    this.#timer = undefined;
    this.#shown_ms = performance.now();
    this.value = this.#latest;
  }
}

/**
 * Asks now, and `every_ms` after each answer, later where the service wants that; `told` hears what went wrong. The
 * function that is returned ends it: nothing is taken or told after it.
 */
export function polled<Answer>(
  ask: (signal: AbortSignal) => Promise<Answer>,
  every_ms: number,
  taken: (answer: Answer) => void,
  told: (error: unknown) => void,
): () => void {
  const ending = new AbortController();
  const { signal } = ending;
  let timer: ReturnType<typeof setTimeout>;
  const begin = async (): Promise<void> => {
    let pause_ms = every_ms;
    try {
      const answer = await ask(signal);
      if (!signal.aborted) taken(answer);
    } catch (error) {
      if (!signal.aborted) told(error);
      pause_ms = pauseAfter(error, every_ms);
    }
    if (!signal.aborted) timer = setTimeout(() => void begin(), pause_ms);
  };
  void begin();
  return () => {
    clearTimeout(timer);
    ending.abort();
  };
}

/** What the service answers, asked for again and again; what `ask` reads at once is followed. */
export class Polled<Answer> {
  /** null: not known yet. */
  answer = $state.raw<Answer | null>(null);
  /** Why the newest answer is not there. */
  problem = $state<string | null>(null);

  /** Must be made while a component is being made; ends with it. */
  constructor(every_ms: number, ask: (signal: AbortSignal) => Promise<Answer>) {
    const taken = (answer: Answer): void => void ([this.answer, this.problem] = [answer, null]);
    $effect(() => polled(ask, every_ms, taken, (error) => (this.problem = explain(error))));
  }
}

/** Something that is tried at a press: whether it is under way, and why it came to nothing. */
export class Attempt {
  busy = $state(false);
  problem = $state<string | null>(null);
  /** Of what was sent, the value to blame for that. */
  field = $state<string | null>(null);
  #ending = new AbortController();

  /** Tries it, in place of what is still tried; false where it came to nothing, or was stopped. */
  async run(work: (signal: AbortSignal) => Promise<unknown>): Promise<boolean> {
    this.stop();
    const { signal } = (this.#ending = new AbortController());
    this.busy = true;
    this.problem = this.field = null;
    try {
      await work(signal);
      return true;
    } catch (error) {
      if (signal.aborted) return false;
      this.problem = explain(error);
      this.field = (error instanceof ServiceError && error.problem.field) || null;
      return false;
    } finally {
      if (!signal.aborted) this.busy = false;
    }
  }

  stop(): void {
    this.#ending.abort();
    this.busy = false;
  }
}

/** Files on their way to the service. They outlive the view that sends them; leaving the page asks first. */
export abstract class Sending extends Attempt {
  /** Those that are under way, or were not taken, for who looks at another view. */
  static readonly all = new SvelteSet<Sending>();
  /** The view that sends it, and what it will be called. */
  abstract readonly view: ViewName;
  abstract name: string;
  /** Share of the bytes that were sent, 0 to 1; null: nothing is under way. */
  share = $state<number | null>(null);

  /** Sends one; null where it was stopped or refused. */
  protected async transfer<Answer>(
    send: (told: Told, signal: AbortSignal) => Promise<Answer>,
  ): Promise<Answer | null> {
    let answer: Answer | null = null;
    const ask = (event: BeforeUnloadEvent): void => event.preventDefault();
    addEventListener("beforeunload", ask);
    this.share = 0;
    Sending.all.add(this);
    await this.run(async (signal) => (answer = await send((share) => (this.share = share), signal)));
    this.share = null;
    if (this.problem === null) Sending.all.delete(this);
    removeEventListener("beforeunload", ask);
    return answer;
  }
}

const COPIED_MS = 1500;
const KEPT_MS = 60_000;

/** Gives a file to the person. */
export function saveBlob(blob: Blob, name: string): void {
  const address = URL.createObjectURL(blob);
  const link = document.createElement("a");
  link.href = address;
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), KEPT_MS); // some browsers read it after the click
}

const PIECE = 0x8000; // of the arguments that a function takes

export function base64(bytes: Uint8Array): string {
  const pieces: string[] = [];
  for (let start = 0; start < bytes.length; start += PIECE) pieces.push(String.fromCharCode(...bytes.subarray(start, start + PIECE)));
  return btoa(pieces.join(""));
}

/** A list of the service that is asked for while somebody looks; answers that come too late are left. */
export abstract class Listed<Answer> {
  /** Why the newest answer is not there. */
  problem = $state<string | null>(null);
  #asked = 0;
  #taken = 0;

  protected abstract ask(): Promise<Answer>;
  protected abstract take(answer: Answer): void;

  /** Asks once; what goes wrong is told as the problem. */
  async refresh(): Promise<void> {
    await this.#answer().catch(() => undefined);
  }

  /** Asks now and from now on; the function that is returned ends it. */
  poll(every_ms: number): () => void {
    const nothing = (): void => undefined;
    return polled(() => this.#answer(), every_ms, nothing, nothing);
  }

  async #answer(): Promise<void> {
    const asked = ++this.#asked;
    try {
      const answer = await this.ask();
      if (asked < this.#taken) return;
      this.#taken = asked;
      this.take(answer);
      this.problem = null;
    } catch (error) {
      if (asked < this.#taken) return;
      this.#taken = asked;
      this.problem = explain(error);
      throw error;
    }
  }
}

/** A text that a person copies. Browsers give the clipboard only to pages that they trust: not over plain HTTP from another machine. */
export class Copying {
  /** Whether the newest was copied a moment ago. */
  done = $state(false);

  /** Copies a text; false where the browser does not let the page: then what `offer` has shown of it is selected. */
  async copy(text: string, offer: () => HTMLInputElement | HTMLTextAreaElement | undefined): Promise<boolean> {
    try {
      await navigator.clipboard.writeText(text);
    } catch {
      const offered = offer();
      offered?.focus();
      offered?.select();
      return false;
    }
    this.done = true;
    setTimeout(() => (this.done = false), COPIED_MS);
    return true;
  }
}
