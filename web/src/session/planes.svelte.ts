/** The image planes of the probes that were seen, asked for once each. */

import { SvelteMap } from "svelte/reactivity";

import { imagePlane, type ImagePlane, type Probe } from "../api/probes";
import type { FrameHeader } from "../api/stream";
import { placedOn, type Placed } from "../geometry/picture";

const MOST_PLACED = 32;

class Planes {
  #known = new SvelteMap<string, ImagePlane>();
  #asked = new Map<string, Promise<ImagePlane>>();
  #placed = new Map<string, Placed>();

  /** The plane of a probe. Throws ServiceError for one that cannot be. */
  get(probe: Probe): Promise<ImagePlane> {
    const key = keyOf(probe);
    const before = this.#asked.get(key);
    if (before !== undefined) return before;
    const asked = imagePlane(probe);
    this.#asked.set(key, asked);
    asked.then(
      (plane) => this.#known.set(key, plane),
      () => this.#asked.delete(key),
    );
    return asked;
  }

  /** The plane of a probe as far as it is known; else it is asked for, and what reads this is told. */
  of(probe: Probe): ImagePlane | null {
    const known = this.#known.get(keyOf(probe));
    if (known === undefined) this.get(probe).catch(() => undefined); // the next frame asks again
    return known ?? null;
  }

  /** Where the pixels of a frame lie, the same object for all frames alike; null until the plane is known. */
  placed({ probe, picture, height, width, rendered_height, display }: FrameHeader): Placed | null {
    const key = JSON.stringify([probe, picture, height, width, rendered_height, display.pixel_mm]);
    const before = this.#placed.get(key);
    if (before !== undefined) return before;
    const plane = this.of(probe);
    if (plane === null) return null;
    const shown = display.pixel_mm === null ? height / rendered_height : null;
    const placed = placedOn(plane, { picture, height, width }, shown);
    if (this.#placed.size >= MOST_PLACED) this.#placed.clear();
    this.#placed.set(key, placed);
    return placed;
  }
}

function keyOf(probe: Probe): string {
  return JSON.stringify(Object.entries(probe).sort());
}

export const planes = new Planes();
