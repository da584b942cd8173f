/** A frame drawn for keeping: square pixels, a centimetre scale, what was set on it, and lines that say what it is. */

import type { SceneDescription } from "../../api/scenes";
import { outputPixels, type Frame } from "../../api/stream";
import { ellipseOf, type EllipsePoints } from "../../geometry/measure";
import { depthTicks, extent_mm, pixelAt, type Placed } from "../../geometry/picture";
import type { PlanePoint } from "../../geometry/plane";
import { poseJson } from "../../geometry/pose_json";
import { confidenceWords } from "../../session/familiar";
import { GREYS } from "../../shared/FrameCanvas.svelte";
import { words } from "../../words/words.svelte";
import type { Mark, Marks } from "../marks.svelte";
import { lettersOf, resultOf } from "../results";

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
      said.slice(slice_thickness_mm),
      said.depthInCm,
      ...(tools.length === 0 ? [] : [said.drawn(tools.map(({ kind }) => words.tools.kinds[kind]).join(", "))]),
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
    const context = this.#picture.getContext("2d");
    const pixels = outputPixels(frame, "bmode");
    if (context === null || pixels === undefined) throw new Error(words.scan.store.noDrawing);
    [this.#picture.width, this.#picture.height] = [width, height];
    const image = context.createImageData(width, height);
    const rgba = new Uint32Array(image.data.buffer);
    for (let index = 0; index < rgba.length; index++) rgba[index] = GREYS[pixels[index]!]!;
    context.putImageData(image, 0, 0);
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
