/** Storing what is shown: drawn on a sheet as a picture or a video, or as DICOM that the service writes. */

import { explain } from "../api/client";
import { type Annotation, framesAsDicom } from "../api/rendering";
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
const BURNT_LONGER_SIDE = 768; // of one frame; a loop must stay small
const BURNT_LOOP_SIDE = 512;
const NO_MARGINS = { top: 0, right: 0, bottom: 0, left: 0 };
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
  readonly #margins: typeof MARGINS;

  /** Large enough for each of the pages, whose frames are of one setting. Throws where the browser cannot draw.
   *
   * `burntWidth`: so wide, and without what stands around the picture: for `annotation` alone.
   */
  constructor(
    private readonly placed: Placed,
    private readonly marks: Marks,
    private readonly description: SceneDescription | null,
    pages: readonly Page[],
    private readonly burntWidth: number | null = null,
  ) {
    const context = this.canvas.getContext("2d");
    if (context === null) throw new Error(words.scan.store.noDrawing);
    this.#context = context;
    const { across, down } = extent_mm(placed);
    this.#margins = burntWidth === null ? MARGINS : NO_MARGINS;
    this.#scale = burntWidth === null ? LONGER_SIDE / Math.max(across, down) : burntWidth / across;
    [this.#width, this.#height] = [across * this.#scale, down * this.#scale];
    context.font = FONT;
    const lines = Math.max(...pages.map((page) => this.#lines(page).length));
    const margins = this.#margins;
    this.canvas.width = burntWidth ?? even(this.#width + margins.left + margins.right);
    this.canvas.height = even(this.#height + margins.top + margins.bottom + LINE * lines);
  }

  /** What was set on a page, to be burnt into its frame: white, edged in black, the results below the picture. */
  annotation(page: Page, frame: number): Annotation {
    const context = this.#context;
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    context.font = FONT;
    context.fillStyle = context.strokeStyle = "#fff";
    [context.shadowColor, context.shadowBlur] = ["#000", 3];
    this.#drawMarks(page);
    this.#drawLines(page);
    const [, picture] = this.canvas.toDataURL("image/png").split(",");
    return { frame, picture: picture!, text: [...this.#measured(page), ...page.marks.map(({ text }) => text)].filter(Boolean).join("\n") };
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
    this.#drawMarks(page);
    context.fillStyle = TEXT;
    this.#drawLines(page);
  }

  #drawMarks({ marks }: Page): void {
    for (const mark of marks) this.#drawMark(mark);
    this.#drawLetters(marks);
  }

  #drawLines(page: Page): void {
    const { left, top, bottom } = this.#margins;
    const first = top + this.#height + bottom + LINE * (this.burntWidth === null ? 0.4 : 0.75);
    for (const [index, line] of this.#lines(page).entries()) this.#context.fillText(line, left, first + LINE * index);
  }

  /** "A  12.0 mm" of each that has a result. */
  #measured({ marks }: Page): string[] {
    return marks.filter(({ kind }) => kind !== "text").map((mark) => `${this.marks.letterOf(mark.id)}  ${resultOf(mark)}`);
  }

  #lines(page: Page): string[] {
    const { frame } = page;
    const measured = this.#wrapped(this.#measured(page), GAP);
    if (this.burntWidth !== null) return measured;
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
    return [
      ...measured,
      ...this.#wrapped(told, GAP),
      ...this.#wrapped(poseJson(pose.flat()).split(/(?<=,)/), ""),
    ];
  }

  /** Pieces of text as lines that fit. */
  #wrapped(pieces: readonly string[], gap: string): string[] {
    const lines: string[] = [];
    for (const piece of pieces) {
      const longer = `${lines.at(-1)}${gap}${piece}`;
      const fits = lines.length > 0 && this.#context.measureText(longer).width <= this.#width + this.#margins.right;
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
    const area = { left: this.#margins.left, top: this.#margins.top, width: this.#width, height: this.#height };
    for (const { letter, box } of lettersOf(marks, this.marks, this.#screenOf, area))
      this.#context.fillText(letter, box.left, box.top + box.height - 3);
  }

  readonly #screenOf = (point: PlanePoint): { x: number; y: number } => {
    const { column, row } = pixelAt(this.placed, point);
    return {
      x: this.#margins.left + ((column + 0.5) / this.placed.width) * this.#width,
      y: this.#margins.top + ((row + 0.5) / this.placed.height) * this.#height,
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
      if (frame !== null) saveBlob(await this.#asDicom([{ frame, marks: this.scan.shown }], BURNT_LONGER_SIDE), `${this.#name}.dcm`);
    });
  }

  loopAsDicom(): Promise<void> {
    return this.#store(words.scan.store.asking, async () => {
      saveBlob(await this.#asDicom(this.#loop, BURNT_LOOP_SIDE), `${this.#name}-cine.dcm`);
    });
  }

  loopAsVideo(): Promise<void> {
    return this.#store(words.scan.store.drawing, async () => {
      const pages = this.#loop;
      const told = (done: number): void => void (this.doing = words.scan.store.recording(done, pages.length));
      const sheet = this.#sheet(pages);
      const draw = (index: number): void => sheet.draw(pages[index]!);
      const { blob, suffix } = await videoOf(sheet.canvas, pages.length, { draw, perSecond: PLAYED_PER_SECOND, told });
      saveBlob(blob, `${this.#name}-cine.${suffix}`);
    });
  }

  get #loop(): Page[] {
    const { cine, marks, session } = this.scan;
    return cine.frames.map((frame, index) => ({
      frame,
      marks: session.frozen ? marks.all.filter((mark) => mark.frame === index) : [],
    }));
  }

  get #name(): string {
    return this.scan.session.name;
  }

  #sheet(pages: readonly Page[], burntWidth: number | null = null): Sheet {
    const placed = pages[0] && planes.placed(pages[0].frame.header);
    if (!placed) throw new Error(words.scan.store.nothing);
    return new Sheet(placed, this.scan.marks, this.scan.session.scene.description, pages, burntWidth);
  }

  /** What is set on the pages is drawn in pixels that are a whole part of the frames'. */
  #asDicom(pages: readonly Page[], side: number): Promise<Blob> {
    const [first] = pages;
    if (first === undefined) throw new Error(words.scan.store.nothing);
    const { height, width } = first.frame.header;
    const sheet = this.#sheet(pages, width * Math.max(1, Math.round(side / Math.max(height, width))));
    const annotations = pages.flatMap((page, index) => (page.marks.length > 0 ? [sheet.annotation(page, index)] : []));
    return framesAsDicom(pages.map(({ frame }) => frame), annotations, this.scan.session.settings(["bmode"]));
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
