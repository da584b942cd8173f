/** The image as a PNG: square pixels, a centimetre scale, measurements and a line that says what it is. */

import type { FrameHeader } from "../api/stream";
import { depthTicks, extent_mm, pixelAt, type Placed } from "../geometry/picture";
import type { PlanePoint } from "../geometry/plane";
import { poseJson } from "../geometry/pose_json";
import { length_mm, type Calliper } from "./callipers.svelte";

const LONGER_SIDE = 1024;
const MARGINS = { top: 30, right: 56, bottom: 22, left: 16 };
const LINE = 20;
const FONT = "13px system-ui, sans-serif";
const TEXT = "#c8d0d8";
const MEASURED = "#ffd84d";
const MARKER = "#5bbde4";
const KEPT_MS = 60_000;

/** Throws where the browser cannot make a PNG of that size. */
export async function screenshot(
  source: HTMLCanvasElement,
  header: FrameHeader,
  placed: Placed,
  callipers: Calliper[],
): Promise<Blob> {
  const { across, down } = extent_mm(placed);
  const scale = LONGER_SIDE / Math.max(across, down);
  const [width, height] = [across * scale, down * scale];
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("2d");
  if (context === null) throw new Error("The browser cannot draw the screenshot.");
  context.font = FONT;
  const slice = `slice ${header.slice_thickness_mm.toFixed(1)} mm`;
  const words = `Simulated, not for diagnosis.   ${header.scene}   ${new Date().toISOString()}   ${slice}   depth in cm`;
  const lines = [words.split("   "), poseJson(header.pose.flat()).split(/(?<=,)/)].flatMap((pieces, index) =>
    wrapped(context, pieces, index === 0 ? "   " : "", width + MARGINS.right),
  );
  canvas.width = Math.round(width + MARGINS.left + MARGINS.right);
  canvas.height = Math.round(height + MARGINS.top + MARGINS.bottom + LINE * lines.length);
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.drawImage(source, MARGINS.left, MARGINS.top, width, height);
  context.font = FONT;
  context.fillStyle = context.strokeStyle = TEXT;
  const rowAt = (row: number): number => MARGINS.top + ((row + 0.5) / placed.height) * height;
  const right = MARGINS.left + width;
  for (const tick of depthTicks(placed)) {
    context.fillRect(right + 4, rowAt(tick.at), tick.label === null ? 5 : 9, 1);
    if (tick.label !== null) context.fillText(`${tick.label}`, right + 18, rowAt(tick.at) + 4);
  }
  const screenOf = (point: PlanePoint): [number, number] => {
    const { column, row } = pixelAt(placed, point);
    return [MARGINS.left + ((column + 0.5) / placed.width) * width, rowAt(row)];
  };
  context.fillStyle = context.strokeStyle = MEASURED;
  for (const calliper of callipers) drawCalliper(context, screenOf(calliper.a), screenOf(calliper.b), length_mm(calliper));
  drawMarker(context, header.display.flip ? right - 8 : MARGINS.left + 8);
  context.fillStyle = TEXT;
  const bottom = MARGINS.top + height + MARGINS.bottom;
  for (const [index, line] of lines.entries()) context.fillText(line, MARGINS.left, bottom + LINE * (index + 0.4));
  const blob = await new Promise<Blob | null>((resolve) => canvas.toBlob(resolve, "image/png"));
  if (blob === null) throw new Error("The browser cannot write the screenshot.");
  return blob;
}

/** Pieces of text as lines that fit into a width in pixels. */
function wrapped(context: CanvasRenderingContext2D, pieces: string[], gap: string, width: number): string[] {
  const lines: string[] = [];
  for (const piece of pieces) {
    const longer = `${lines.at(-1)}${gap}${piece}`;
    if (lines.length > 0 && context.measureText(longer).width <= width) lines[lines.length - 1] = longer;
    else lines.push(piece);
  }
  return lines;
}

/** On the side of the probe's mark, as above the live image. */
function drawMarker(context: CanvasRenderingContext2D, x: number): void {
  const y = MARGINS.top / 2;
  context.fillStyle = context.strokeStyle = MARKER;
  context.beginPath();
  context.arc(x, y, 8, 0, 2 * Math.PI);
  context.stroke();
  context.fillText("U", x - context.measureText("U").width / 2, y + 4.5);
}

function drawCalliper(context: CanvasRenderingContext2D, a: [number, number], b: [number, number], mm: number): void {
  context.beginPath();
  context.moveTo(...a);
  context.lineTo(...b);
  for (const [x, y] of [a, b]) {
    context.moveTo(x - 6, y);
    context.lineTo(x + 6, y);
    context.moveTo(x, y - 6);
    context.lineTo(x, y + 6);
  }
  context.stroke();
  context.fillText(`${mm.toFixed(1)} mm`, (a[0] + b[0]) / 2 + 8, (a[1] + b[1]) / 2 - 6);
}

/** Gives a file to the person. */
export function saveBlob(blob: Blob, name: string): void {
  const address = URL.createObjectURL(blob);
  const link = document.createElement("a");
  link.href = address;
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), KEPT_MS); // some browsers read it after the click
}
