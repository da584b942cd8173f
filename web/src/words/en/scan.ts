/** The Scan view in English. */

import type { Contact } from "../../api/stream";
import type { Command } from "../../scan/commands";
import type { MarkKind } from "../../scan/marks.svelte";

const kinds: Record<MarkKind, string> = { distance: "Measure", ellipse: "Ellipse", angle: "Angle", text: "Text" };
const kindHints: Record<MarkKind, string> = {
  distance: "Measure a distance (M or D)",
  ellipse: "Measure circumference and area with an ellipse (E)",
  angle: "Measure an angle (A)",
  text: "Write on the image (T)",
};
const commands: Record<Command, string> = {
  freeze: "Freeze and unfreeze",
  distance: "Measure a distance",
  ellipse: "Measure an ellipse",
  angle: "Measure an angle",
  text: "Write on the image",
  leave: "Leave the tool",
  store: "Store the picture as PNG",
  play: "Play the sweep; frozen, the cine loop",
  previousFrame: "Frozen: the frame before",
  nextFrame: "Frozen: the next frame",
  home: "To the middle of the sweep",
  snap: "To the nearest training view",
  undo: "Undo",
  redo: "Redo",
  slower: "Steer slower",
  faster: "Steer faster",
  large: "Large image",
  keys: "Show these keys",
};
const keyNames: Record<string, string> = { escape: "Esc", " ": "Space", ctrl: "Ctrl", shift: "Shift", plus: "+", "-": "−" };
const steering: { title: string; lines: [string, string][] }[] = [
  {
    title: "Steering by keys",
    lines: [
      ["← →", "slide along the image (lateral); with Shift rotate"],
      ["↑ ↓", "slide across the image (elevation); with Shift tilt"],
      ["Page ↑ Page ↓", "lift and press (axial); with Shift rock"],
      ["with Alt", "finely"],
    ],
  },
  {
    title: "On the image",
    lines: [
      ["Drag, one finger", "slides the probe: sideways along the image, up and down across it"],
      ["Shift or right button", "dragging sideways rotates, up and down tilts"],
      ["Two fingers", "twisting rotates, moving sideways rocks"],
      ["Pinch", "sets the depth"],
      ["Enter with a tool", "puts a measurement in the middle; arrow keys move its points, Delete removes it"],
    ],
  },
  {
    title: "Gamepad",
    lines: [
      ["Left stick, triggers", "slide"],
      ["Right stick, shoulders", "turn"],
      ["A", "freeze"],
      ["B", "snap"],
      ["X", "store"],
      ["Y", "home"],
    ],
  },
];
const contacts: Record<Contact, string> = { air: "Dark", pressure: "Dark; pressed tissue gives way" };
/** Of the settings of the display; English takes the words of the service where it names none. */
const fields: Record<string, string | undefined> = { dynamic_range_db: "Range", tgc_db: "Time-gain compensation" };

export const scan = {
  close: "Close",
  room: "Scene in space",
  group: (name: string): string => `${name}: show or hide`,
  groups: { confidence: "Confidence", display: "Image", tools: "Tools", pose: "Pose", locate: "Frame search", registrations: "Registrations", path: "Path", connect: "Connect" },
  image: {
    label: "Live image",
    of: (scene: string): string => `B-mode image of ${scene}`,
    steer: "B-mode image; the arrow and page keys and dragging move the probe",
    frozen: "Frozen",
    live: (perSecond: number): string => (perSecond < 1 ? "Live" : `Live, ${perSecond.toFixed(0)} frames/s`),
    noConnection: "No connection",
    stands: "The image is frozen, so the probe stays. Unfreeze first (F).",
  },
  toolbar: {
    label: "Image tools",
    tools: "Measuring and writing",
    freeze: "Freeze",
    freezeHint: "Freeze or unfreeze (F)",
    kinds,
    kindHints,
    removeAll: "Remove all",
    undo: "Undo",
    undoHint: "Undo (Ctrl+Z)",
    redo: "Redo",
    redoHint: "Redo (Ctrl+Shift+Z)",
    large: "Large image",
    largeHint: "Large image (L)",
    keys: "Keys and gestures",
    keysHint: "Keys and gestures (?)",
  },
  cine: {
    label: "Cine loop",
    play: "Play the cine loop",
    pause: "Pause the cine loop",
    previous: "Previous frame",
    next: "Next frame",
    frame: "Frame of the cine loop",
  },
  marks: {
    label: "Measurements",
    write: "Text on the image, Enter sets it",
    annotation: (text: string): string => `Text ${text}: move with the arrow keys, Enter changes it, Delete removes it`,
    handle: (letter: string, kind: MarkKind, point: number): string =>
      `${letter}, ${kind}, point ${point}: move with the arrow keys, with Shift faster, Delete removes it`,
  },
  results: {
    label: "Results",
    ellipse: ({ axes, circumference, area }: Record<"axes" | "circumference" | "area", string>): string =>
      `${axes}, circumference ${circumference}, area ${area}`,
    frame: (number: number): string => `on frame ${number}`,
    remove: (letter: string): string => `Remove ${letter}`,
  },
  store: {
    save: "Save",
    saveHint: "Store the picture as PNG (S)",
    more: "More ways to store",
    png: "Picture, PNG",
    dicom: "Frame, DICOM",
    loopAsDicom: (most: number) => `Cine loop, DICOM (newest ${most} frames)`,
    loopAsVideo: (type: string): string => `Cine loop, video (${type})`,
    drawing: "Drawing …",
    asking: "The service is writing the file …",
    recording: (done: number, all: number): string => `Recording the video: frame ${done} of ${all}`,
    nothing: "There is no frame to store yet.",
    noDrawing: "This browser cannot draw the picture.",
    noPicture: "This browser cannot write the picture.",
    noVideo: "This browser cannot record video. DICOM can hold the loop, too.",
    simulated: "Simulated, not for diagnosis.",
    drawn: (tools: string): string => `Drawn in: ${tools}`,
    slice: (thickness_mm: number): string => `slice ${thickness_mm.toFixed(1)} mm`,
    depthInCm: "depth in cm",
  },
  link: {
    copy: "Copy link",
    hint: "Copy the link to this view: scene, pose, probe and settings",
    copied: "Copied",
    byHand: "This browser does not let the page copy. The link is selected: press Ctrl+C.",
  },
  keys: {
    title: "Keys and gestures",
    oneKey: "Keys",
    singleKeys: "Single keys do something (Ctrl+Z and Esc always do)",
    speed: "Speed of steering",
    names: keyNames,
    commands,
    steering,
  },
  tgc: {
    short: "TGC",
    label: "Time-gain compensation",
    hint: "Time-gain compensation: gain at each depth. Catches at 0; a double click sets 0.",
    slider: (index: number, count: number): string => `Time-gain compensation ${index} of ${count}, dB`,
  },
  display: {
    label: "Display",
    title: "Image",
    reset: "Reset",
    frozen: "Frozen: these settings are those of the loop. Unfreeze to change them.",
    depth: "Depth",
    slice: "Slice",
    sliceThickness: "Slice thickness",
    trained: (thickness_mm: number): string => `As trained: ${thickness_mm.toFixed(1)} mm.`,
    contact: "Off the skin",
    contactMeans: "What is shown where the face of the probe is not on the skin, which the training sweep tells",
    contactAssumed: "As on it",
    contacts,
    noSkin: "The training sweep does not tell where the skin is",
    samples: "Samples",
    asTrained: "As trained",
    geometry: "Geometry",
    sector: "Sector",
    scanLines: "Scan lines",
    probe: "Probe",
    fields,
  },
};
