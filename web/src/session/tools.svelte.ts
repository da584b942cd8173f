/** The tools in the image of a session, which of them is worked on, and the ghosts beside them. */

import { exampleTool, MOST_TOOLS, type Tool, type ToolKind } from "../api/tools";
import type { History } from "./history.svelte";

export class Tools {
  #all = $state.raw<readonly Tool[]>([]);
  /** Share of what lies before the first strong interface that is heard once more beyond it. */
  ghost = $state(0);
  #chosen = $state(0);
  readonly chosen = $derived.by(() => Math.min(this.#chosen, this.#all.length - 1));
  readonly current = $derived.by<Tool | null>(() => this.#all[this.chosen] ?? null);
  readonly isFull = $derived.by(() => this.#all.length >= MOST_TOOLS);

  constructor(private readonly history: History) {}

  get all(): readonly Tool[] {
    return this.#all;
  }

  choose(index: number): void {
    this.#chosen = index;
  }

  /** Adds one, which is then worked on. `placed` puts it somewhere. */
  add(kind: ToolKind, placed: (tool: Tool) => Tool): void {
    this.#change([...this.#all, placed(exampleTool(kind))]);
    this.#chosen = this.#all.length - 1;
  }

  /** Puts a changed one in the place of that which is worked on. */
  change(tool: Tool): void {
    this.#change(this.#all.map((before, index) => (index === this.chosen ? tool : before)), `tool ${this.chosen}`);
  }

  removeChosen(): void {
    this.#change(this.#all.filter((_, index) => index !== this.chosen));
  }

  /** Takes all of them and the ghosts from elsewhere; not a step that can be undone. */
  take(all: readonly Tool[], ghost: number): void {
    this.#all = all;
    this.ghost = ghost;
    this.#chosen = 0;
  }

  /** Changes of one `run` are one step. */
  #change(all: readonly Tool[], run: string | null = null): void {
    this.history.change((put) => (this.#all = put), this.#all, all, { run });
    this.#all = all;
  }
}
