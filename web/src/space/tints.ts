/** The colours of what is shown in space, and the values that they stand for. */

import { labelColour, ramp, type Colour } from "../shared/colours";
import type { ColourBy } from "./appearance";

/** Of a palette. */
export const ENTRIES = 256;
/** Of the intensity: from dark tissue to bright bone. */
const TISSUE: readonly Colour[] = [
  [38, 24, 30],
  [112, 66, 60],
  [186, 138, 108],
  [232, 208, 172],
  [255, 250, 238],
];

/** The colour of a share of the values, 0 to 1; of labels, the share is the label in 255ths. */
export function colourOf(by: ColourBy, share: number): Colour {
  if (by === "label") return share === 0 ? [120, 128, 136] : labelColour(Math.round(share * (ENTRIES - 1)));
  if (by !== "intensity") return ramp(by, share);
  const at = share * (TISSUE.length - 1);
  const index = Math.min(TISSUE.length - 2, Math.floor(at));
  const [low, high] = [TISSUE[index]!, TISSUE[index + 1]!];
  return [0, 1, 2].map((i) => Math.round(low[i]! + (high[i]! - low[i]!) * (at - index))) as unknown as Colour;
}
