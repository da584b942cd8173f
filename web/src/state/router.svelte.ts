/** Where the page is: #/VIEW/NAME. */

export const VIEWS = ["scan", "maps", "compare", "train", "scenes"] as const;
export type ViewName = (typeof VIEWS)[number];

export interface Route {
  view: ViewName;
  /** Of a scene; empty: the view chooses. */
  name: string;
}

class Router {
  route = $state.raw<Route>(parse(location.hash));

  constructor() {
    addEventListener("hashchange", () => (this.route = parse(location.hash)));
  }
}

function parse(hash: string): Route {
  const [view = "", name = ""] = hash.replace(/^#\//, "").split("/");
  const known = VIEWS.find((one) => one === view);
  return { view: known ?? "scan", name: known === undefined ? "" : decodeName(name) };
}

function decodeName(name: string): string {
  try {
    return decodeURIComponent(name);
  } catch {
    return name;
  }
}

/** The address of a view. */
export function href(view: ViewName, name = ""): string {
  return name === "" ? `#/${view}` : `#/${view}/${encodeURIComponent(name)}`;
}

export const router = new Router();
