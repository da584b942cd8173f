/** The crop that is drawn on a frame of the sweep that was chosen, before it is sent. */

import { holds, readEdges, whole, writeCrop, type Crop } from "../geometry/crop";
import { Sequence, type SequenceFrame } from "./sequence";
import { sweepUpload } from "./sweep_upload.svelte";

export type Preview = "none" | "reading" | "shown" | "unreadable";

class CropDrawing {
  state = $state<Preview>("none");
  frame = $state.raw<SequenceFrame | null>(null);
  index = $state(0);
  frames = $state(0);
  #sequence: Sequence | null = null;
  #asked = 0;

  /** The edges as they are written among the options, also outside of the image; null: no edges are written there. */
  readonly edges = $derived.by<Crop | null>(() => {
    if (this.frame === null) return null;
    const written = sweepUpload.options.crop ?? "";
    return written.trim() === "" ? whole(this.frame) : readEdges(written, this.frame);
  });
  /** null: what is written is no crop of this image. */
  readonly crop = $derived(this.frame !== null && this.edges !== null && holds(this.edges, this.frame) ? this.edges : null);

  /** Looks into files that were chosen. */
  async look(files: readonly File[]): Promise<void> {
    const asked = ++this.#asked;
    this.state = "none";
    this.frame = null;
    this.index = 0;
    if (!files.some(({ name }) => /\.(mha|mhd|nrrd|nhdr)$/i.test(name))) return;
    this.state = "reading";
    try {
      const sequence = await Sequence.among(files);
      const frame = (await sequence?.frame(0)) ?? null;
      if (asked !== this.#asked) return;
      this.#sequence = sequence;
      this.frames = sequence?.frames ?? 0;
      this.frame = frame;
      this.state = frame === null ? "unreadable" : "shown";
    } catch {
      if (asked === this.#asked) this.state = "unreadable";
    }
  }

  async show(index: number): Promise<void> {
    const asked = this.#asked;
    this.index = index;
    const frame = (await this.#sequence?.frame(index)) ?? null;
    if (asked === this.#asked && index === this.index && frame !== null) this.frame = frame;
  }

  draw(crop: Crop): void {
    sweepUpload.options.crop = writeCrop(crop);
  }

  /** Takes the whole image again. */
  clear(): void {
    sweepUpload.options.crop = "";
  }
}

export const cropDrawing = new CropDrawing();
