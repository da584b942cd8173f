/** A value for reading: it follows another at most a few times a second, so that live images leave time to draw. */

const EVERY_MS = 125;

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
