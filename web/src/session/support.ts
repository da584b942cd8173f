/** The pixels that are drawn over an image: RGBA in the byte order of a canvas, the lowest byte red. */

const SUPPORTED = 0.3 * 255; // coverage below which the service counts a pixel as not supported
const LINES = 44; // across the image
const MOST_PIXELS = 320; // of a layer, on its longer side
const HATCH = rgba(150, 205, 235, 0.42);
/** Standard deviation, in grey levels of 0 to 1, that gets the full colour. */
export const MOST_UNCERTAIN = 0.25;
const COLOURS = Uint32Array.from({ length: 256 }, (_, value) => uncertainColour(value / 255 / MOST_UNCERTAIN));

/** Pixels that lie over those of a frame; of a large frame fewer, so that drawing them costs no frames. */
export interface Layer {
  width: number;
  height: number;
  /** Pixels of the frame from one to the next. */
  step: number;
}

export function layerOver({ width, height }: { width: number; height: number }): Layer {
  const step = Math.ceil(Math.max(width, height) / MOST_PIXELS);
  return { width: Math.ceil(width / step), height: Math.ceil(height / step), step };
}

/** Draws diagonal lines where the coverage is low; `width`: of the frame. */
export function hatched(pixels: Uint32Array, layer: Layer, coverage: Uint8Array, width: number): void {
  const period = Math.max(5, Math.round(layer.width / LINES));
  const thick = Math.max(1, Math.round(period / 5));
  for (let row = 0; row < layer.height; row++) {
    const of = row * layer.step * width;
    for (let column = 0; column < layer.width; column++)
      if ((column + row) % period < thick && coverage[of + column * layer.step]! < SUPPORTED)
        pixels[row * layer.width + column] = HATCH;
  }
}

/** Colours pixels by the error that they are expected to have. */
export function uncertain(pixels: Uint32Array, layer: Layer, deviation: Uint8Array, width: number): void {
  for (let row = 0; row < layer.height; row++) {
    const of = row * layer.step * width;
    for (let column = 0; column < layer.width; column++)
      pixels[row * layer.width + column] = COLOURS[deviation[of + column * layer.step]!]!;
  }
}

/** From nothing over yellow to magenta, as CSS for the scale. */
export function uncertaintyScale(): string {
  const stops = [0, 0.25, 0.5, 0.75, 1].map((share) => {
    const [red, green, blue, alpha] = shades(share);
    return `rgba(${red}, ${green}, ${blue}, ${alpha})`;
  });
  return `linear-gradient(to right, ${stops.join(", ")})`;
}

function uncertainColour(share: number): number {
  const [red, green, blue, alpha] = shades(Math.min(1, share));
  return rgba(red, green, blue, alpha);
}

function shades(share: number): [number, number, number, number] {
  return [255, Math.round(205 - 165 * share), Math.round(40 + 130 * share), Number((0.75 * share).toFixed(3))];
}

function rgba(red: number, green: number, blue: number, alpha: number): number {
  return ((Math.round(alpha * 255) << 24) | (blue << 16) | (green << 8) | red) >>> 0;
}
