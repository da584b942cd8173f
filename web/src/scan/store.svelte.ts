/** Storing what is shown: drawn on a sheet as a picture or a video, or as DICOM that the service writes. */

import { explain } from "../api/client";
import { framesAsDicom, MOST_DICOM_FRAMES } from "../api/rendering";
import type { SceneDescription } from "../api/scenes";
import { type Frame, outputPixels } from "../api/stream";
import { depthTicks, ellipseOf, type EllipsePoints, extent_mm, pixelAt, type Placed, type PlanePoint } from "../geometry/plane";
import { poseJson } from "../geometry/pose_files";
import { confidenceWords } from "../session/confidence.svelte";
import { planes } from "../session/scene.svelte";
import { saveBlob } from "../shared/asking.svelte";
import { colour, GREYS, paint } from "../shared/colours";
import { fixed, nameIn } from "../shared/text";
import { videoOf } from "../shared/video";
import { words } from "../words/words.svelte";
import { lettersOf, type Mark, type Marks, PLAYED_PER_SECOND, resultOf, type ScanState } from "./scan.svelte";

const LONGER_SIDE = 1024;
const MARGINS = { top: 30, right: 56, bottom: 22, left: 16 };
const LINE = 20;
const FONT = "13px system-ui, sans-serif";
const TEXT = "#c8d0d8";
const MEASURED = "#ffd84d";
const MARKER = "#5bbde4";
const TONES = { good: "#63c690", warn: "#e3b04b", bad: "#f28b82" };
const FRAME = 3;
const GAP = "   ";

/** A frame with the marks that lie on it. */
export interface Page {
  frame: Frame;
  marks: readonly Mark[];
}

/** A frame drawn for keeping: square pixels, a centimetre scale, what was set on it, and lines that say what it is. */
export class Sheet {
  readonly canvas = document.createElement("canvas");
  readonly #context: CanvasRenderingContext2D;
  readonly #picture = document.createElement("canvas");
  readonly #width: number;
  readonly #height: number;
  readonly #scale: number;

  /** Large enough for each of the pages, whose frames are of one setting. Throws where the browser cannot draw. */
  constructor(
    private readonly placed: Placed,
    private readonly marks: Marks,
    private readonly description: SceneDescription | null,
    pages: readonly Page[],
  ) {
    const context = this.canvas.getContext("2d");
    if (context === null) throw new Error(words.scan.store.noDrawing);
    this.#context = context;
    const { across, down } = extent_mm(placed);
    this.#scale = LONGER_SIDE / Math.max(across, down);
    [this.#width, this.#height] = [across * this.#scale, down * this.#scale];
    context.font = FONT;
    const lines = Math.max(...pages.map((page) => this.#lines(page).length));
    this.canvas.width = even(this.#width + MARGINS.left + MARGINS.right);
    this.canvas.height = even(this.#height + MARGINS.top + MARGINS.bottom + LINE * lines);
  }

  draw(page: Page): void {
    const context = this.#context;
    context.font = FONT;
    context.fillStyle = "#000";
    context.fillRect(0, 0, this.canvas.width, this.canvas.height);
    this.#drawPicture(page.frame);
    this.#drawScale();
    this.#drawConfidence(page.frame);
    this.#drawMarker(page.frame.header.display.flip);
    context.fillStyle = context.strokeStyle = MEASURED;
    for (const mark of page.marks) this.#drawMark(mark);
    this.#drawLetters(page.marks);
    context.fillStyle = TEXT;
    const bottom = MARGINS.top + this.#height + MARGINS.bottom;
    for (const [index, line] of this.#lines(page).entries()) context.fillText(line, MARGINS.left, bottom + LINE * (index + 0.4));
  }

  #lines({ frame, marks }: Page): string[] {
    const { scene, slice_thickness_mm, pose, tools, ghost } = frame.header;
    const warning = confidenceWords(frame.header, this.description)?.warning ?? "";
    const said = words.scan.store;
    const told = [
      said.simulated,
      ...(warning === "" ? [] : [`${warning}.`]),
      scene,
      new Date().toISOString(),
      said.slice(fixed(slice_thickness_mm, 1)),
      said.depthInCm,
      ...(tools.length === 0 ? [] : [said.drawn(tools.map(({ kind }) => nameIn(words.tools.kinds, kind)).join(", "))]),
      ...(ghost === 0 ? [] : [words.tools.ghostMeans]),
    ];
    const measured = marks.filter(({ kind }) => kind !== "text").map((mark) => `${this.marks.letterOf(mark.id)}  ${resultOf(mark)}`);
    return [
      ...this.#wrapped(measured, GAP),
      ...this.#wrapped(told, GAP),
      ...this.#wrapped(poseJson(pose.flat()).split(/(?<=,)/), ""),
    ];
  }

  /** Pieces of text as lines that fit. */
  #wrapped(pieces: readonly string[], gap: string): string[] {
    const lines: string[] = [];
    for (const piece of pieces) {
      const longer = `${lines.at(-1)}${gap}${piece}`;
      const fits = lines.length > 0 && this.#context.measureText(longer).width <= this.#width + MARGINS.right;
      if (fits) lines[lines.length - 1] = longer;
      else lines.push(piece);
    }
    return lines;
  }

  #drawPicture(frame: Frame): void {
    const { height, width } = frame.header;
    const values = outputPixels(frame, "bmode");
    if (values === undefined) throw new Error(words.scan.store.noDrawing);
    paint(this.#picture, width, height, (pixels) => colour(pixels, values, GREYS));
    this.#context.drawImage(this.#picture, MARGINS.left, MARGINS.top, this.#width, this.#height);
  }

  #drawScale(): void {
    const context = this.#context;
    context.fillStyle = TEXT;
    const right = MARGINS.left + this.#width;
    for (const { at, label } of depthTicks(this.placed)) {
      const y = MARGINS.top + ((at + 0.5) / this.placed.height) * this.#height;
      context.fillRect(right + 4, y, label === null ? 5 : 9, 1);
      if (label !== null) context.fillText(label, right + 18, y + 4);
    }
  }

  #drawConfidence({ header }: Frame): void {
    const told = confidenceWords(header, this.description);
    if (told === null) return;
    const text = `${told.title}, ${told.detail}`;
    this.#context.fillStyle = TONES[told.tone];
    const middle = MARGINS.left + (this.#width - this.#context.measureText(text).width) / 2;
    this.#context.fillText(text, middle, MARGINS.top / 2 + 4.5);
    if (told.tone !== "good") this.#drawFrame(TONES[told.tone]);
  }

  /** Around the picture, as around the live image of a guess. */
  #drawFrame(colour: string): void {
    this.#context.strokeStyle = colour;
    this.#context.lineWidth = FRAME;
    this.#context.strokeRect(MARGINS.left - FRAME / 2, MARGINS.top - FRAME / 2, this.#width + FRAME, this.#height + FRAME);
    this.#context.lineWidth = 1;
  }

  /** On the side of the probe's mark, as above the live image. */
  #drawMarker(flip: boolean): void {
    const context = this.#context;
    const [x, y] = [flip ? MARGINS.left + this.#width - 8 : MARGINS.left + 8, MARGINS.top / 2];
    context.fillStyle = context.strokeStyle = MARKER;
    context.beginPath();
    context.arc(x, y, 8, 0, 2 * Math.PI);
    context.stroke();
    context.fillText("U", x - context.measureText("U").width / 2, y + 4.5);
  }

  #drawMark({ kind, points, text }: Mark): void {
    const context = this.#context;
    const at = points.map(this.#screenOf);
    if (kind === "text") {
      const { x, y } = at[0]!;
      context.fillText(text, Math.max(4, Math.min(x, this.canvas.width - context.measureText(text).width - 4)), y);
      return;
    }
    context.beginPath();
    if (kind === "ellipse") {
      const { centre, first_mm, second_mm, turn_deg } = ellipseOf(points as EllipsePoints);
      const { x, y } = this.#screenOf(centre);
      const turn = (turn_deg * Math.PI) / 180;
      const mirrored = this.placed.picture.step[0] < 0;
      context.ellipse(x, y, first_mm * this.#scale, second_mm * this.#scale, mirrored ? -turn : turn, 0, 2 * Math.PI);
    } else {
      for (const [index, { x, y }] of at.entries()) context[index === 0 ? "moveTo" : "lineTo"](x, y);
    }
    for (const { x, y } of at) {
      context.moveTo(x - 6, y);
      context.lineTo(x + 6, y);
      context.moveTo(x, y - 6);
      context.lineTo(x, y + 6);
    }
    context.stroke();
  }

  #drawLetters(marks: readonly Mark[]): void {
    const area = { left: MARGINS.left, top: MARGINS.top, width: this.#width, height: this.#height };
    for (const { letter, box } of lettersOf(marks, this.marks, this.#screenOf, area))
      this.#context.fillText(letter, box.left, box.top + box.height - 3);
  }

  readonly #screenOf = (point: PlanePoint): { x: number; y: number } => {
    const { column, row } = pixelAt(this.placed, point);
    return {
      x: MARGINS.left + ((column + 0.5) / this.placed.width) * this.#width,
      y: MARGINS.top + ((row + 0.5) / this.placed.height) * this.#height,
    };
  };
}

/** Encoders of video want even sides. */
function even(value: number): number {
  return 2 * Math.ceil(value / 2);
}

/** Throws where the browser cannot make a PNG of that size. */
export async function pngOf(sheet: Sheet, page: Page): Promise<Blob> {
  sheet.draw(page);
  const blob = await new Promise<Blob | null>((resolve) => sheet.canvas.toBlob(resolve, "image/png"));
  if (blob === null) throw new Error(words.scan.store.noPicture);
  return blob;
}

/** Storing what is shown: as a picture, as DICOM, and the loop as DICOM or as a video. */
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
      const sheet = this.#sheet(pages);
      const draw = (index: number): void => sheet.draw(pages[index]!);
      const { blob, suffix } = await videoOf(sheet.canvas, pages.length, { draw, perSecond: PLAYED_PER_SECOND, told });
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
