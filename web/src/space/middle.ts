/** The range that values are spread over. */

/** Between which the middle 96 % of the values lie. */
export function middleOf(values: Float32Array): [number, number] {
  const sorted = values.sort();
  const low = sorted[Math.floor(sorted.length * 0.02)] ?? 0;
  const high = sorted[Math.floor(sorted.length * 0.98)] ?? 1;
  return [low, high > low ? high : low + 1];
}
