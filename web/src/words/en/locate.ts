/** Where a real frame was taken, in English. */

import type { Within } from "../../api/rendering";

const within: Record<keyof Within, string> = { within_mm: "Off by", within_deg: "Turned by" };
const withinMeans: Record<keyof Within, string> = {
  within_mm: "How far the probe may be off, mm",
  within_deg: "By which angle the probe may be turned",
};

export const locate = {
  title: "Where was this frame taken?",
  label: "Where a real frame was taken",
  choose: "Choose a frame",
  chooseHint: "PNG as the scanner stores it: a column a scan line, not scan-converted",
  size: (width: number, height: number): string => `${width} × ${height} pixels; choose another one here`,
  notPng: (name: string): string => `${name} is not a PNG file.`,
  damaged: (name: string): string => `${name} is damaged: it cannot be shown as a picture.`,
  scanConverted:
    "This looks like a picture of the screen: a fan on black ground. It will hardly be found. Needed is the frame before scan conversion, rows along the depth, a column for each scan line.",
  within,
  withinMeans,
  search: "Search",
  searchMeans: "Look for the frame about where the probe is now",
  fromHere: "from the present pose",
  searching: "Searching …",
  rendering: "Rendering what is there …",
  stop: "Stop",
  found: "Found.",
  notFound:
    "Not found. Move the probe nearer to where the frame was taken, allow it to be further off, or check that frame, probe and scene belong together.",
  similarity: "Similarity",
  similarityMeans: "Correlation of the structures of the frame and of the scene there, -1 to 1; the right place has more than half",
  positionStd: "Position ±",
  positionStdMeans: "Standard deviations along the probe's lateral, elevation and axial axis",
  angleStd: "Angles ±",
  angleStdMeans: "Standard deviations about the lateral, elevation and axial axis",
  fromStart: "From the start",
  took: "Search took",
  seconds: (amount: string): string => `${amount} s`,
  take: "Go there",
  takeMeans: "Takes the pose that was found as that of the probe",
  frozen: "The image is frozen. Unfreeze it first (F).",
  pictures: "How both pictures are shown",
  side: "Side by side",
  blend: "Blend",
  given: "Given",
  rendered: "Rendered",
  shareOfRendered: "Share of the rendered picture",
};
