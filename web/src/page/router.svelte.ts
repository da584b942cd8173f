/** Where the page is: #/VIEW/NAME?KEY=VALUE&…, the values being what the view keeps in its address. */

export const VIEWS = ["scan", "maps", "compare", "train", "scenes"] as const;
export type ViewName = (typeof VIEWS)[number];
const OF_SCENE: readonly ViewName[] = ["scan", "maps", "compare"];

/** Whether the name in the address of a view is a scene's. */
export function isOfScene(view: ViewName): boolean {
  return OF_SCENE.includes(view);
}

export interface Route {
  view: ViewName;
  /** Of a scene; empty: the view chooses. */
  name: string;
}

/** Values of the address by key. */
export type Kept = Readonly<Record<string, string>>;

const WRITTEN_EVERY_MS = 400; // browsers refuse pages that change their address more than a few times a second

class Router {
  #address = $state.raw(parse(location.hash));
  readonly #view = $derived(this.#address.view);
  readonly #name = $derived(this.#address.name);
  readonly route: Route = $derived({ view: this.#view, name: this.#name });
  /** What the address keeps for the view: as it was opened, gone back to, or put last. */
  readonly kept: Kept = $derived(this.#address.kept);
  /** How often the person came to an address by another way than the page itself: a view reads `kept` anew then. */
  arrivals = $state(0);
  #seen = location.hash;
  #writtenAt = -WRITTEN_EVERY_MS; // of performance.now()
  #timer: ReturnType<typeof setTimeout> | undefined;

  constructor() {
    addEventListener("hashchange", () => this.#arrive());
    addEventListener("popstate", () => this.#arrive());
    addEventListener("pagehide", () => this.#write());
  }

  /** Keeps values in the address of the view that is shown; null removes one. `entry`: a step that Back undoes. */
  keep(values: Record<string, string | null>, { entry = false } = {}): void {
    const before = this.#address.kept;
    if (Object.entries(values).every(([key, value]) => (before[key] ?? null) === value)) return;
    const kept = { ...before, ...values };
    const present = Object.fromEntries(Object.entries(kept).filter(([, value]) => value !== null)) as Kept;
    if (entry) this.#write();
    this.#address = { ...this.#address, kept: present };
    if (entry) {
      history.pushState(null, "", (this.#seen = this.link));
      return;
    }
    const wait_ms = this.#writtenAt + WRITTEN_EVERY_MS - performance.now();
    this.#timer ??= setTimeout(() => this.#write(), wait_ms);
    if (wait_ms <= 0) this.#write(); // at once: the page may be loaded anew before a timer comes
  }

  /** The address of what is shown, as a part of the page's. */
  get link(): string {
    const { view, name, kept } = this.#address;
    return href(view, name, kept);
  }

  /** Brings the address up to what was kept. */
  #write(): void {
    if (this.#timer === undefined) return;
    clearTimeout(this.#timer);
    this.#timer = undefined;
    this.#writtenAt = performance.now();
    history.replaceState(null, "", (this.#seen = this.link));
  }

  #arrive(): void {
    if (location.hash === this.#seen) return; // a step back is told twice
    this.#seen = location.hash;
    clearTimeout(this.#timer);
    this.#timer = undefined;
    this.#address = parse(location.hash);
    this.arrivals += 1;
  }
}

function parse(hash: string): Route & { kept: Kept } {
  const [path = "", query = ""] = hash.replace(/^#\//, "").split("?", 2);
  const [view = "", name = ""] = path.split("/");
  const known = VIEWS.find((one) => one === view);
  if (known === undefined) return { view: "scan", name: "", kept: {} };
  return { view: known, name: decodeName(name), kept: Object.fromEntries(new URLSearchParams(query)) };
}

function decodeName(name: string): string {
  try {
    return decodeURIComponent(name);
  } catch {
    return name;
  }
}

/** The address of a view. */
export function href(view: ViewName, name = "", kept: Kept = {}): string {
  const path = name === "" ? `#/${view}` : `#/${view}/${encodeURIComponent(name)}`;
  const query = new URLSearchParams(kept).toString();
  return query === "" ? path : `${path}?${query}`;
}

export const router = new Router();
