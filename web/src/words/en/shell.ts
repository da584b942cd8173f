/** The header, the key form and the menu of the key, in English. */

import type { Me } from "../../api/access";
import type { ViewName } from "../../shell/router.svelte";
import type { ServiceStatus } from "../../shell/service.svelte";

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
  admin: "You may do everything, with everybody's.",
};

export const shell = {
  views,
  status,
  toScan: "UltraG-Ray, to the scan view",
  viewsLabel: "Views",
  scene: "Scene",
  noScene: "none",
  lightColours: "Light colours",
  darkColours: "Dark colours",
  language: "Language",
  noScenes: "No scenes yet.",
  trainOne: "Train one from a sweep",
  or: "or",
  importOne: "import a scene file",
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
    roles,
    may,
  },
};
