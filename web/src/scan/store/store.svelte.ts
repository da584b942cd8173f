/** Storing what is shown: as a picture, as DICOM, and the loop as DICOM or as a video. */

import { explain } from "../../api/client";
import { framesAsDicom, MOST_DICOM_FRAMES } from "../../api/dicom";
import type { Frame } from "../../api/stream";
import { planes } from "../../session/planes.svelte";
import { saveBlob } from "../../shared/save";
import { words } from "../../words/words.svelte";
import { PLAYED_PER_SECOND } from "../cine.svelte";
import type { ScanState } from "../scan.svelte";
import { pngOf, videoOf } from "./files";
import { Sheet, type Page } from "./sheet";

export class Store {
  /** What is being done, in words; null: nothing. */
  doing = $state<string | null>(null);
  problem = $state<string | null>(null);

  constructor(
    private readonly scan: ScanState,
    /** The frame that is shown. */
    private readonly shown: () => Frame | null,
  ) {}

  picture(): Promise<void> {
    return this.#store(words.scan.store.drawing, async () => {
      const frame = this.shown();
      if (frame === null) return;
      const page = { frame, marks: this.scan.shown };
      saveBlob(await pngOf(this.#sheet([page]), page), `${this.#name}.png`);
    });
  }

  dicom(): Promise<void> {
    return this.#store(words.scan.store.asking, async () => {
      const frame = this.shown();
      if (frame !== null) saveBlob(await this.#asDicom([frame]), `${this.#name}.dcm`);
    });
  }

  loopAsDicom(): Promise<void> {
    return this.#store(words.scan.store.asking, async () => {
      saveBlob(await this.#asDicom(this.scan.cine.frames.slice(-MOST_DICOM_FRAMES)), `${this.#name}-cine.dcm`);
    });
  }

  loopAsVideo(): Promise<void> {
    return this.#store(words.scan.store.drawing, async () => {
      const { cine, marks, session } = this.scan;
      const pages = cine.frames.map((frame, index) => ({
        frame,
        marks: session.frozen ? marks.all.filter((mark) => mark.frame === index) : [],
      }));
      const told = (done: number): void => void (this.doing = words.scan.store.recording(done, pages.length));
      const { blob, suffix } = await videoOf(this.#sheet(pages), pages, { perSecond: PLAYED_PER_SECOND, told });
      saveBlob(blob, `${this.#name}-cine.${suffix}`);
    });
  }

  get #name(): string {
    return this.scan.session.name;
  }

  #sheet(pages: readonly Page[]): Sheet {
    const placed = pages[0] && planes.placed(pages[0].frame.header);
    if (!placed) throw new Error(words.scan.store.nothing);
    return new Sheet(placed, this.scan.marks, this.scan.session.scene.description, pages);
  }

  #asDicom(frames: readonly Frame[]): Promise<Blob> {
    if (frames.length === 0) throw new Error(words.scan.store.nothing);
    return framesAsDicom(frames.map(({ header }) => header), this.scan.session.settings(["bmode"]));
  }

  async #store(doing: string, work: () => Promise<void>): Promise<void> {
    if (this.doing !== null) return;
    this.doing = doing;
    this.problem = null;
    try {
      await work();
    } catch (error) {
      this.problem = explain(error);
    } finally {
      this.doing = null;
    }
  }
}
