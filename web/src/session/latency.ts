/** How long frames take, from being asked for to being on the screen. */

const KEPT = 240; // frames

export interface LatencyFigures {
  p50_ms: number;
  p99_ms: number;
  /** Since what is on the screen was asked for. */
  age_ms: number;
  /** Poses that newer ones replaced, in all. */
  dropped: number;
}

export class Latency {
  #times_ms: number[] = [];
  #asked_ms = 0;
  #dropped = 0;

  /** A frame that was asked for so long ago is on the screen now. */
  shown(took_ms: number, now_ms: number): void {
    this.#times_ms.push(took_ms);
    if (this.#times_ms.length > KEPT) this.#times_ms.shift();
    this.#asked_ms = now_ms - took_ms;
  }

  /** So many poses were replaced before a frame that has come. */
  dropped(poses: number): void {
    this.#dropped += poses;
  }

  /** null before the first frame. */
  figures(now_ms: number): LatencyFigures | null {
    if (this.#times_ms.length === 0) return null;
    const ordered = [...this.#times_ms].sort((a, b) => a - b);
    const at = (share: number): number => ordered[Math.min(ordered.length - 1, Math.floor(share * ordered.length))]!;
    return { p50_ms: at(0.5), p99_ms: at(0.99), age_ms: now_ms - this.#asked_ms, dropped: this.#dropped };
  }
}
