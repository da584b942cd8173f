/** Places for short texts beside points, so that none prints over another. */

export interface Box {
  left: number;
  top: number;
  width: number;
  height: number;
}

/** A text that stands beside a point. */
export interface Label {
  x: number;
  y: number;
  width: number;
  height: number;
}

const AWAY = [9, 22, 38]; // pixels from the point
const DIRECTIONS = [[1, -1], [1, 1], [-1, -1], [-1, 1], [1, 0], [-1, 0], [0, -1], [0, 1]] as const; // prettier-ignore

/** A box for each label within `area`: the nearest to its point that is free; over another only where nothing is. */
export function placeLabels(labels: readonly Label[], area: Box, taken: readonly Box[] = []): Box[] {
  const placed = [...taken];
  return labels.map((label) => {
    const choices = AWAY.flatMap((away) => DIRECTIONS.map((direction) => beside(label, direction, away)));
    const inside = choices.filter((box) => isWithin(box, area));
    const box = inside.find((one) => !placed.some((other) => overlap(one, other))) ?? inside[0] ?? choices[0]!;
    placed.push(box);
    return box;
  });
}

export function overlap(a: Box, b: Box): boolean {
  return a.left < b.left + b.width && b.left < a.left + a.width && a.top < b.top + b.height && b.top < a.top + a.height;
}

function beside({ x, y, width, height }: Label, [across, down]: readonly [number, number], away: number): Box {
  return {
    left: x + across * (away + width / 2) - width / 2,
    top: y + down * (away + height / 2) - height / 2,
    width,
    height,
  };
}

function isWithin(box: Box, area: Box): boolean {
  return (
    box.left >= area.left &&
    box.top >= area.top &&
    box.left + box.width <= area.left + area.width &&
    box.top + box.height <= area.top + area.height
  );
}
