/** Colours of maps: one ramp for each kind of value, categories for labels. */

export type Ramp = keyof typeof STOPS;
export type Colour = readonly [number, number, number];

/** From low to high; each grows lighter all the way, so that it can be read in grey and by those who see few colours. */
const STOPS = {
  intensity: [
    [20, 16, 38],
    [85, 30, 105],
    [168, 48, 98],
    [233, 107, 62],
    [250, 193, 98],
    [255, 250, 225],
  ],
  transmittance: [
    [12, 18, 40],
    [26, 60, 105],
    [30, 112, 140],
    [63, 165, 145],
    [150, 210, 130],
    [250, 245, 170],
  ],
  coverage: [
    [0, 32, 77],
    [61, 78, 107],
    [114, 117, 121],
    [165, 156, 116],
    [214, 200, 97],
    [255, 234, 70],
  ],
  uncertainty: [
    [16, 20, 28],
    [66, 44, 50],
    [128, 66, 50],
    [190, 100, 44],
    [232, 152, 60],
    [255, 224, 140],
  ],
} satisfies Record<string, Colour[]>;

/** The share at which the colours of a map end, where it hardly ever shows more. */
const ENDS: Record<string, number> = { attenuation: 0.4, uncertainty: 0.3 };

/** Of labels from 1 on; 0 is nothing. */
const CATEGORIES: Colour[] = [
  [240, 228, 200],
  [204, 92, 84],
  [238, 190, 80],
  [86, 140, 214],
  [92, 178, 120],
  [176, 120, 200],
  [230, 140, 180],
  [120, 190, 200],
];

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
