/** How the pictures of the bench become pixels: grey, difference, similarity. */

import { ramp, type Colour } from "../shared/colours";
import type { Grey } from "./picture";

/** The grey values at which the colours of a difference end. */
export const DIFFERENCE_END = 64;
/** Brighter and darker than the truth: orange and blue, which few people confuse; none is black. */
const BRIGHTER: Colour = [255, 168, 64];
const DARKER: Colour = [84, 164, 255];

export type Pixels = ImageData;

export function greyPixels({ width, height, values }: Grey): Pixels {
  return pixels(width, height, (index) => [values[index]!, values[index]!, values[index]!]);
}

export function differenceColour(value: number): Colour {
  const share = Math.min(1, Math.abs(value) / DIFFERENCE_END);
  const [r, g, b] = value > 0 ? BRIGHTER : DARKER;
  return [r * share, g * share, b * share];
}

/** Dark where the pictures agree not at all, light where they are alike. */
export function similarityColour(value: number): Colour {
  return ramp("coverage", value);
}

export function pixels(width: number, height: number, colour: (index: number) => Colour): Pixels {
  const image = new ImageData(width, height);
  for (let index = 0; index < width * height; index++) {
    image.data.set(colour(index), 4 * index);
    image.data[4 * index + 3] = 255;
  }
  return image;
}
