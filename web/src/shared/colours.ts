/** Colours of maps: one ramp for each kind of value, categories for labels. */

export type Ramp = keyof typeof STOPS;
export type Colour = readonly [number, number, number];

/** From low to high; each grows lighter all the way, so that it can be read in grey and by those who see few colours. */
const STOPS = {
  intensity: coloursOf("#141026 #551e69 #a83062 #e96b3e #fac162 #fffae1"),
  transmittance: coloursOf("#0c1228 #1a3c69 #1e708c #3fa591 #96d282 #faf5aa"),
  coverage: coloursOf("#00204d #3d4e6b #727579 #a59c74 #d6c861 #ffea46"),
  uncertainty: coloursOf("#10141c #422c32 #804232 #be642c #e8983c #ffe08c"),
  tissue: coloursOf("#26181e #70423c #ba8a6c #e8d0ac #fffaee"), // of the intensity in space: from dark tissue to bright bone
};

/** The share at which the colours of a map end, where it hardly ever shows more. */
const ENDS: Record<string, number> = { attenuation: 0.4, uncertainty: 0.3 };

/** Of labels from 1 on; 0 is nothing. */
const CATEGORIES = coloursOf("#f0e4c8 #cc5c54 #eebe50 #568cd6 #5cb278 #b078c8 #e68cb4 #78bec8");

/** Whether values of that name have a ramp of their own. */
export function isRamp(name: string): name is Ramp {
  return name in STOPS;
}

export function endOf(name: string): number {
  return ENDS[name] ?? 1;
}

/** The colour of a share of a ramp, 0 to 1. */
export function ramp(name: Ramp, share: number): Colour {
  const stops: readonly Colour[] = STOPS[name];
  const at = Math.max(0, Math.min(1, share)) * (stops.length - 1);
  const index = Math.min(stops.length - 2, Math.floor(at));
  const [low, high] = [stops[index]!, stops[index + 1]!];
  const mix = (i: 0 | 1 | 2): number => Math.round(low[i] + (high[i] - low[i]) * (at - index));
  return [mix(0), mix(1), mix(2)];
}

/** The colour of a share of the way to the end of what a map shows. */
export function shareColour(output: string, share: number): Colour {
  if (isRamp(output)) return ramp(output, share);
  const grey = Math.max(0, Math.min(255, Math.round(255 * share)));
  return [grey, grey, grey];
}

export function labelColour(label: number): Colour {
  return label === 0 ? [0, 0, 0] : CATEGORIES[(label - 1) % CATEGORIES.length]!;
}

/** RGBA of the 256 values of a pixel, in the byte order of a canvas. */
export function table(colour: (value: number) => Colour): Uint32Array {
  return Uint32Array.from({ length: 256 }, (_, value) => {
    const [r, g, b] = colour(value);
    return (0xff000000 | (b << 16) | (g << 8) | r) >>> 0;
  });
}

export function css([r, g, b]: Colour): string {
  return `rgb(${r} ${g} ${b})`;
}

/** The grey of each value, as RGBA in the byte order of a canvas. */
export const GREYS = table((value) => [value, value, value]);

/** Fills pixels with the colours of values. */
export function colour(pixels: Uint32Array, values: Uint8Array, colours: Uint32Array): void {
  for (let index = 0; index < pixels.length; index++) pixels[index] = colours[values[index]!]!;
}

const images = new WeakMap<HTMLCanvasElement, ImageData>(); // one each: a live image leaves no time to clear up after it

/** Paints a canvas, which becomes as large. `fill` sets the pixels, RGBA in its byte order; they are what they were before. */
export function paint(
  canvas: HTMLCanvasElement,
  width: number,
  height: number,
  fill: (pixels: Uint32Array) => void,
  settings: CanvasRenderingContext2DSettings = {},
): void {
  const context = canvas.getContext("2d", settings);
  if (canvas.width !== width) canvas.width = width;
  if (canvas.height !== height) canvas.height = height;
  const before = images.get(canvas);
  const image = before?.width === width && before.height === height ? before : new ImageData(width, height);
  images.set(canvas, image);
  fill(new Uint32Array(image.data.buffer));
  context?.putImageData(image, 0, 0);
}

function coloursOf(hex: string): Colour[] {
  return hex.split(" ").map((one) => [1, 3, 5].map((at) => parseInt(one.slice(at, at + 2), 16)) as unknown as Colour);
}
