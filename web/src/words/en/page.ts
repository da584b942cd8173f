/** The page itself, what several views use, Maps and Compare, in English. */

import type { Me } from "../../api/service";
import type { Named } from "../translated";

export const shell = {
  views: {
    scan: "Scan",
    maps: "Maps",
    compare: "Compare",
    train: "Train",
    scenes: "Scenes and service",
  },
  status: {
    asking: "Connecting",
    ready: "Service ready",
    starting: "Service not ready",
    down: "Service down",
    locked: "Key needed",
  },
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
    roles: { reader: "reader", operator: "operator", admin: "admin" },
    may: {
      reader: "You may look, render and stream.",
      operator: "You may also start jobs, add sweeps and scenes, and delete what is yours.",
      admin: "You may do everything, also with what belongs to others.",
    },
  },
};

/** "from -3 to 5 mm", "at least 1", "a number". */
function limits(least: number, most: number, unit: string): string {
  const mm = unit && ` ${unit}`;
  if (Number.isFinite(least) && Number.isFinite(most)) return `a number from ${least} to ${most}${mm}`;
  if (Number.isFinite(least)) return `a number of at least ${least}${mm}`;
  return Number.isFinite(most) ? `a number of at most ${most}${mm}` : "a number";
}

export const shared = {
  chart: (title: string, unit: string, x: string, series: string[]): string =>
    `${title}${unit && ` in ${unit}`} over ${x}: ${series.join(", ")}`,
  nameValue: (line: string): string => `"${line}" must be written as name = value.`,
  metrics: "Metrics",
  better: (higher: boolean): string => (higher ? "higher is better" : "lower is better"),
  slider: {
    value: "value",
    outside: (least: number, most: number, unit: string): string => `This takes ${limits(least, most, unit)}.`,
    reset: (value: number, unit: string): string => `Double click: ${value}${unit && ` ${unit}`}`,
  },
  field: {
    usual: "as usual",
    ofList: (label: string, place: number, count: number): string => `${label} ${place} of ${count}`,
    labels: {
      below_min_confidence: "Below that",
      contact: "Off the skin",
      dtype: "Numbers as",
      height: "Depth samples",
      min_confidence: "Least confidence",
      reverberation: "Comet tail",
      shard_frames: "Frames in a file",
      width: "Scan lines",
    } as Named,
  },
  only: (who: string, what: string): string => `Only ${who} may ${what}.`,
  keep: "Keep",
  fetching: "Fetching …",
  loading: "Loading",
  you: "you",
  private: "private",
  privateTo: (owner: string | null): string => `Only ${owner === null ? "" : `${owner} and `}admins see it`,
  privateChoice: "Private",
  privateMeans: "only you and admins see it",
};

export const maps = {
  outputs: {
    bmode: { title: "B-mode", meaning: "What a scanner shows: the echo times what is left of the beam." },
    echo: { title: "Echo", meaning: "How strongly the tissue reflects, before the way there takes its share." },
    transmittance: { title: "Transmittance", meaning: "The share of the beam that is left at that depth." },
    coverage: { title: "Coverage", meaning: "How well what was learned supports the pixel; below 0.3 it is mostly a guess." },
    attenuation: { title: "Attenuation", meaning: "The share of the beam that arrives at the pixel and ends there." },
    labels: { title: "Labels", meaning: "The tissue that weighs most in the pixel, or the tool that is there." },
    uncertainty: { title: "Uncertainty", meaning: "The error that the brightness of the pixel is expected to have." },
  } as Readonly<Record<string, { title: string; meaning: string } | undefined>>,
  group: "Maps; the arrow keys move the cursor, with Shift faster",
  enlarge: (title: string): string => `${title}, show large`,
  canvas: (title: string): string => `${title} map`,
  legend: (end: number): string => `Scale from 0 to ${end}, from dark to light`,
  noLabel: "none",
  label: (number: number): string => `label ${number}`,
  cursor: {
    title: "Cursor",
    lateral: "Lateral",
    depth: "Depth",
    pixel: "Column, row",
    hint: "Point at a map, or move the cursor with the arrow keys. A click on a small map makes it the large one. Hatched: beside the image, nothing is known there.",
  },
  corrections: {
    title: "Corrected poses",
    meaning: "How far the training moved and turned the probe from where the tracker saw it. A click goes to the view.",
    shift: "Shift",
    turn: "Turn",
    view: "training view",
  },
};

export const compare = {
  asking: "Asking for the comparison …",
  running: (dataset: string): string =>
    `The held-out frames of ${dataset} are predicted and measured. This is done once and takes a minute or two.`,
  progress: "Comparison",
  anew: "The service begins anew once a minute has passed.",
  tryAgain: "Try again",
  noDataset: {
    title: "The sweep of this scene is not here",
    detail: "A comparison shows the scene beside real frames that it has not seen. They are in the sweep that it was trained from, with the same frames held out.",
    upload: "Upload the sweep",
  },
  truth: { title: "Truth", meaning: "as it was recorded; no method has seen it" },
  pictures: {
    rendering: { short: "Rendering", title: "Rendering", meaning: "of the scene at the frame's pose" },
    median: { short: "Median", title: "Median compounding", meaning: "the median of what the training frames show there" },
    linear: { short: "Linear", title: "Linear between frames", meaning: "blended from the training frames on both sides" },
    nearest: { short: "Nearest", title: "Nearest frame", meaning: "the training frame that lies nearest" },
  },
  scene: (name: string): string => `Scene ${name}`,
  otherScene: "rendered from another scene of the same sweep",
  difference: { title: "Difference", meaning: "orange: brighter than the truth, blue: darker" },
  similarity: { title: "Similarity", meaning: "SSIM of each pixel of the pictures as shown; light: alike" },
  pictureOf: (title: string, frame: number): string => `${title} of frame ${frame}`,
  toolbar: "How pictures are compared",
  against: "Compare the truth with",
  mode: "Way of looking",
  modes: { side: "Side by side", wipe: "Wipe", flicker: "Flicker" },
  wipe: "Where the truth ends and the other begins",
  flicker: { shown: (title: string): string => `Shown: ${title}`, pause: "Hold (X swaps)", play: "Flicker" },
  zoom: { in: "Zoom in", out: "Zoom out", reset: "All of the picture", hint: "Wheel or +, − and 0: zoom of all pictures; dragging moves them." },
  cursor: (truth: number, other: number): string => `truth ${truth}, other ${other} of 255`,
  noCursor: "Point at a picture to read its values",
  frame: "Frame",
  frameNumber: (number: number): string => `Frame ${number}`,
  place: (place: number, count: number, dataset: string): string => `${place} of ${count} held out, ${dataset}`,
  before: "Frame before",
  next: "Next frame",
  order: "Order",
  orders: { sweep: "As recorded", worst: "Worst first" },
  worst: "Worst",
  typical: "Typical",
  best: "Best",
  inScan: "Open this pose in Scan",
  csv: "Save as CSV",
  methods: "Other methods",
  table: { label: "Table of metrics", frame: "This frame", mean: "Mean of all" },
  metric: "Metric",
  chart: { x: "held-out frame", hint: (better: string): string => `${better}; a click goes to the frame` },
  confidence: {
    title: "Expected and measured similarity",
    expected: "expected MS-SSIM",
    measured: "measured MS-SSIM",
    r: (value: string): string => `correlation ${value}`,
    none: "The scene was trained without confidence.",
    point: (frame: number): string => `Frame ${frame}`,
  },
};
