/** What can be undone and done again, in the order in which it was done. */

const MOST = 200;
const PAUSE_MS = 500; // what goes on without a longer pause is one step

interface Step {
  undo(): void;
  redo(): void;
  /** What it belongs to, and is forgotten with. */
  of?: object | undefined;
}

/** A value that went from one to another. */
class Change<T> implements Step {
  constructor(
    private readonly put: (value: T) => void,
    private readonly before: T,
    private after: T,
    readonly of?: object,
  ) {}
  undo(): void {
    this.put(this.before);
  }
  redo(): void {
    this.put(this.after);
  }
  /** Goes on to a further value. */
  extend(after: unknown): void {
    this.after = after as T;
  }
}

export class History {
  #done = $state.raw<readonly Step[]>([]);
  #undone = $state.raw<readonly Step[]>([]);
  readonly canUndo = $derived(this.#done.length > 0);
  readonly canRedo = $derived(this.#undone.length > 0);
  /** What may still go on: its name, its step, and when it went on last. */
  #open: { run: string; step: Change<unknown>; at_ms: number } | null = null;

  add(step: Step): void {
    this.#done = [...this.#done, step].slice(-MOST);
    this.#undone = [];
    this.#open = null;
  }

  /** Adds a change of a value. Changes of the same `run` without a pause between them are one step. */
  change<T>(put: (value: T) => void, before: T, after: T, { run = null, of }: { run?: string | null; of?: object } = {}): void {
    const now_ms = performance.now();
    if (run !== null && this.#open?.run === run && now_ms - this.#open.at_ms < PAUSE_MS) {
      this.#open.step.extend(after);
      this.#open.at_ms = now_ms;
      return;
    }
    const step = new Change(put, before, after, of);
    this.add(step);
    if (run !== null) this.#open = { run, step: step as Change<unknown>, at_ms: now_ms };
  }

  undo(): void {
    const step = this.#done.at(-1);
    if (step === undefined) return;
    this.#done = this.#done.slice(0, -1);
    this.#undone = [...this.#undone, step];
    this.#open = null;
    step.undo();
  }

  redo(): void {
    const step = this.#undone.at(-1);
    if (step === undefined) return;
    this.#undone = this.#undone.slice(0, -1);
    this.#done = [...this.#done, step];
    this.#open = null;
    step.redo();
  }

  /** Forgets the steps that belong to something. */
  forget(of: object): void {
    this.#done = this.#done.filter((step) => step.of !== of);
    this.#undone = this.#undone.filter((step) => step.of !== of);
    this.#open = null;
  }

  clear(): void {
    this.#done = this.#undone = [];
    this.#open = null;
  }
}
