/** Where a picture, or several linked ones, are enlarged. */

const MOST = 16;
const STEP = 1.25;

/** In shares of a picture's width (u) and height (v). */
export interface Share {
  u: number;
  v: number;
}

export class Lens {
  zoom = $state(1);
  /** The share that lies in the middle. */
  x = $state(0.5);
  y = $state(0.5);
  /** Where the pointer is. */
  cursor = $state.raw<Share | null>(null);

  /** Enlarges by steps about a place, which stays where it is. */
  zoomBy(steps: number, about?: Share): void {
    this.zoomTo(this.zoom * STEP ** steps, about);
  }

  zoomTo(wanted: number, about: Share = { u: this.x, v: this.y }): void {
    const zoom = Math.max(1, Math.min(MOST, wanted));
    const kept = this.zoom / zoom;
    [this.x, this.y] = [about.u + (this.x - about.u) * kept, about.v + (this.y - about.v) * kept];
    this.zoom = zoom;
    this.#stay();
  }

  /** Moves the pictures by shares of their own size. */
  moveBy(u: number, v: number): void {
    [this.x, this.y] = [this.x - u, this.y - v];
    this.#stay();
  }

  /** Attaches the wheel: it enlarges about the share that `about` says, or does nothing where that is null. */
  byWheel(about: (event: WheelEvent) => Share | null): (element: HTMLElement) => () => void {
    return (element) => {
      const turn = (event: WheelEvent): void => {
        const share = about(event);
        if (share === null) return;
        event.preventDefault();
        this.zoomBy(-Math.sign(event.deltaY), share);
      };
      element.addEventListener("wheel", turn, { passive: false }); // Svelte listens passively, and the page would scroll
      return () => element.removeEventListener("wheel", turn);
    };
  }

  reset(): void {
    [this.zoom, this.x, this.y] = [1, 0.5, 0.5];
  }

  #stay(): void {
    const half = 0.5 / this.zoom;
    this.x = Math.max(half, Math.min(1 - half, this.x));
    this.y = Math.max(half, Math.min(1 - half, this.y));
  }
}
