/** A scene as it is scanned: what stands in its way, what an address tells, in English. */

export const session = {
  link: {
    refused: (values: readonly string[]): string =>
      `The address holds ${values.length === 1 ? "a value" : "values"} that cannot be used, and the view opened without: ${values.join(", ")}.`,
    pose: "seven numbers: x, y, z, w, i, j, k",
    quaternion: "the quaternion must have length 1",
    number: "not a number",
    count: (count: number): string => `${count} numbers`,
    within: (low: number, high: number): string => `${low} to ${high}`,
    oneOf: (choices: readonly string[]): string => `one of ${choices.join(", ")}`,
  },
  notice: {
    missing: (scene: string): string => `There is no scene ${scene} here.`,
    thereAre: (count: number): string => (count === 1 ? "There is" : "There are"),
    unreadable: (detail: string): string => `This scene file cannot be read: ${detail}`,
    down: "The service does not answer. The view goes on by itself as soon as it does.",
    barred:
      "The service answers, but no live images come through. Something between this browser and the service holds the live connection back; whoever runs the service can open it.",
    barredKey: "Or this key has as many streams open as it may.",
  },
};
