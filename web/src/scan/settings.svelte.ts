/** How a person likes the Scan view, kept by the browser. */

const STORAGE = "ultragray.scan";
export const SPEEDS = [0.25, 0.5, 1, 2, 4] as const;
/** Groups that are closed until a person opens them. */
const SELDOM = ["locate", "registrations"];

class ScanSettings {
  /** Whether the image has nearly all of the window. */
  large = $state(false);
  /** Of steering, against the usual one. */
  speed = $state<number>(1);
  /** Whether keys without Ctrl do something. */
  singleKeys = $state(true);
  /** Names of the groups of controls that are closed. */
  closed = $state.raw<readonly string[]>(SELDOM);

  constructor() {
    try {
      const kept = JSON.parse(localStorage.getItem(STORAGE) ?? "{}") as Partial<ScanSettings>;
      if (typeof kept.large === "boolean") this.large = kept.large;
      if ((SPEEDS as readonly unknown[]).includes(kept.speed)) this.speed = kept.speed!;
      if (typeof kept.singleKeys === "boolean") this.singleKeys = kept.singleKeys;
      if (Array.isArray(kept.closed)) this.closed = kept.closed.filter((name) => typeof name === "string");
    } catch {
      // what cannot be read is left as it comes
    }
    $effect.root(() => {
      $effect(() => {
        const { large, speed, singleKeys, closed } = this;
        localStorage.setItem(STORAGE, JSON.stringify({ large, speed, singleKeys, closed }));
      });
    });
  }

  toggleGroup(name: string): void {
    this.closed = this.closed.includes(name) ? this.closed.filter((one) => one !== name) : [...this.closed, name];
  }

  /** To the next slower or faster speed. */
  changeSpeed(by: 1 | -1): void {
    const index = SPEEDS.findIndex((speed) => speed === this.speed) + by;
    this.speed = SPEEDS[Math.max(0, Math.min(SPEEDS.length - 1, index))]!;
  }
}

export const scanSettings = new ScanSettings();
