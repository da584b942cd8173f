/** How the frames of a scene are shown, whatever the probe. */

import { defaultsOf } from "../api/described";
import { settings } from "../api/generated/contract";
import type { Contact, Display } from "../api/stream";
import { areUpright, boxOf, type ImagePlane } from "../geometry/plane";

/** Depth samples and scan lines that are offered, beside those of the training. */
export const SIZES = [128, 256, 384, 512, 768];
export const DISPLAY = settings.properties!.display!;
export const CONTACTS = settings.properties!.contact!.enum as Contact[];
export const AS_RENDERED = defaultsOf(DISPLAY) as Display;
const MOST_PICTURE_PIXELS = 640; // on the longer side of a scan-converted fan

export class ImageSettings {
  /** How frames are shown, but for the scan conversion. */
  display = $state.raw<Display>(AS_RENDERED);
  scanConverted = $state(true);
  /** Depth samples and scan lines; null: as trained. */
  samples = $state<number | null>(null);
  /** Thickness along elevation, at the focus of the scene's beam; 0: a plane; null: as trained. */
  sliceThickness_mm = $state<number | null>(null);
  /** What is shown of the probe's contact with the skin; null: it is assumed. */
  contact = $state<Contact | null>(null);
  /** Whether what no Gaussians support is black. */
  hidesUnsupported = $state(false);

  /** The display as the stream takes it, of images in that plane; `plain`: without what changes the values of pixels. */
  displayIn(plane: ImagePlane, plain: boolean): Display {
    const { depth_mm, flip } = this.display;
    return {
      ...(plain ? { ...AS_RENDERED, depth_mm, flip } : this.display),
      pixel_mm: this.scanConverted ? squarePixel_mm(plane) : null,
    };
  }

  /** Takes back what the display panel sets, but for the number of samples. */
  reset(): void {
    this.display = AS_RENDERED;
    this.sliceThickness_mm = null;
    this.contact = null;
  }

  /** What fits any probe is kept, the depth of another one is not. */
  forgetDepth(): void {
    this.display = { ...this.display, depth_mm: null };
  }

  /** What was chosen for another scene does not fit this one. */
  beginAnew(): void {
    this.samples = this.sliceThickness_mm = this.contact = null;
    this.forgetDepth();
  }
}

/** The pixel of a scan-converted picture; null for probes whose frames are pictures already. */
function squarePixel_mm({ lines_mm }: ImagePlane): number | null {
  if (areUpright(lines_mm)) return null;
  const { left, right, top, bottom } = boxOf(lines_mm);
  return Math.max(right - left, bottom - top) / MOST_PICTURE_PIXELS;
}
