/** Maps, in English. */

import type { Output } from "../../api/contract";

const outputs: Record<Output, { title: string; meaning: string }> = {
  bmode: { title: "B-mode", meaning: "What a scanner shows: the echo times what is left of the beam." },
  echo: { title: "Echo", meaning: "How strongly the tissue reflects, before the way there takes its share." },
  transmittance: { title: "Transmittance", meaning: "The share of the beam that is left at that depth." },
  coverage: { title: "Coverage", meaning: "How well what was learned supports the pixel; below 0.3 it is mostly a guess." },
  attenuation: { title: "Attenuation", meaning: "The share of the beam that arrives at the pixel and ends there." },
  labels: { title: "Labels", meaning: "The tissue that weighs most in the pixel, or the tool that is there." },
  uncertainty: { title: "Uncertainty", meaning: "The error that the brightness of the pixel is expected to have." },
};

export const maps = {
  outputs,
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
