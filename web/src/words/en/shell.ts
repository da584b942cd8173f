/** The header, the key form and the menu of the key, in English. */

import type { Me } from "../../api/service";

const views: Record<ViewName, string> = {
  scan: "Scan",
  maps: "Maps",
  compare: "Compare",
  train: "Train",
  scenes: "Scenes and service",
};
const status: Record<ServiceStatus, string> = {
  asking: "Connecting",
  ready: "Service ready",
  starting: "Service not ready",
  down: "Service down",
  locked: "Key needed",
};
const roles: Record<Me["role"], string> = { reader: "reader", operator: "operator", admin: "admin" };
const may: Record<Me["role"], string> = {
  reader: "You may look, render and stream.",
  operator: "You may also start jobs, add sweeps and scenes, and delete what is yours.",
  admin: "You may do everything, also with what belongs to others.",
};

export const shell = {
  views,
  status,
  toScan: "UltraG-Ray, to the scan view",
  viewsLabel: "Views",
  scene: "Scene",
  noScene: "none",
  language: "Language",
  noScenes: "No scenes yet",
  noScenesMeans: "A scene is what you scan here. It is trained from a tracked sweep, or read from a file.",
  trainOne: "Train one from a sweep",
  importOne: "Import a scene file",
  toContent: "To the content",
  product: "UltraG-Ray",
  settings: {
    title: "Settings",
    colours: "Colours",
    themes: { system: "As the system", light: "Light", dark: "Dark" },
    release: "Release",
    renderer: "Rendered by",
    nothingYet: "nothing yet",
    address: "Service",
    docs: "Documentation of the API",
    licences: "Licences",
  },
  login: {
    at: (place: string): string => `Sign in at ${place}`,
    orKey: "or with a key",
    failed: (why: string): string => `Signing in failed: ${why}`,
    needsHttps: "Browsers allow this only on pages that came over HTTPS. Open the console by its https:// address, or use a key.",
    notAsked: "this tab did not ask for it. Please try again.",
    away: "the login does not answer at the moment.",
    noToken: "the login gave no token.",
  },
  serviceDown: "The service does not answer. Trying again every second.",
  notLoaded: "This part of the console could not be loaded.",
  tryAgain: "Try again",
  key: {
    asked: "This service asks for a key",
    kept: "It is kept in this tab only, until the tab is closed.",
    label: "API key",
    open: "Open",
    odd: "A key is made of plain letters, digits and signs; this one holds others (a typographic dash or quote?).",
    refused: "The service does not take this key.",
    yours: "Your key",
    name: "Name",
    role: "Role",
    expires: "Expires",
    never: "never",
    another: "Use another key",
    administer: "Workers and audit log",
    allowed: (who: readonly Me["role"][], owner: string | null): string =>
      [...(owner === null ? [] : [owner]), ...who.map((role) => `${role}s`)].join(" and "),
    roles,
    may,
  },
};
