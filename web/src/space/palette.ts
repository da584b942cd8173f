/** Tables of colours for the shaders. */

import { DataTexture, NearestFilter } from "three";

import type { ColourBy } from "./appearance";
import { colourOf, ENTRIES } from "./tints";

/** RGBA by share. */
export function paletteTexture(): DataTexture {
  const texture = new DataTexture(new Uint8Array(4 * ENTRIES), ENTRIES, 1);
  texture.minFilter = texture.magFilter = NearestFilter;
  return texture;
}

export function fillPalette(texture: DataTexture, by: ColourBy): void {
  const data = texture.image.data as Uint8Array;
  for (let entry = 0; entry < ENTRIES; entry++) data.set([...colourOf(by, entry / (ENTRIES - 1)), 255], 4 * entry);
  texture.needsUpdate = true;
}

/** For each label, whether it is shown, in the red of a texel. */
export function fillShown(texture: DataTexture, hidden: readonly number[]): void {
  const data = texture.image.data as Uint8Array;
  for (let label = 0; label < ENTRIES; label++) data[4 * label] = hidden.includes(label) ? 0 : 255;
  texture.needsUpdate = true;
}
