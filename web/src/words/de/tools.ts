/** Tools in the image, in German. */

import type { Words } from "../en/english";

const kinds = { needle: "Nadel", cylinder: "Zylinder", box: "Quader" };
const adding = { needle: "Eine Nadel", cylinder: "Einen Zylinder", box: "Einen Quader" };

export const tools: Words["tools"] = {
  title: "Instrumente",
  label: "Instrumente im Bild",
  frozen: "Eingefroren: Das Bild behält seine Instrumente. Zum Ändern weiterlaufen lassen.",
  add: "Neu",
  addOne: (kind) => `${adding[kind]} einsetzen`,
  kinds,
  one: (place, kind) => `${place} ${kinds[kind]}`,
  chosen: "Instrument",
  remove: "Entfernen",
  full: (most) => `Ein Bild fasst höchstens ${most} Instrumente.`,
  frame: "Bezug des Instruments",
  frames: { scene: "Bleibt in der Szene", probe: "Folgt dem Schallkopf" },
  toImage: "Ins Bild",
  toImageMeans: "In die Bildebene setzen, wo der Schallkopf gerade ist",
  tip: "Spitze",
  middle: "Mitte",
  placeOf: (what, axis) => `${what} ${axis}`,
  direction: "Richtung",
  steepness: "Neigung",
  steepnessMeans: "Neigung: wie steil es entlang Z nach unten geht, von -89° bis 89°",
  heading: "Kurs",
  headingMeans: "Kurs: von X nach Y, entlang Z gesehen",
  turn: "Drehung",
  size: "Größe",
  length: "Länge",
  ghost: "Geister",
  ghostMeans: "Geisterechos",
  along: "Entlang der Achse",
  advance: (by_mm) => (by_mm > 0 ? `Um ${by_mm} mm vorschieben` : `Um ${-by_mm} mm zurückziehen`),
  seen: (what, beside_mm, depth_mm) => `${what}: ${beside_mm} mm neben dem Bild, ${depth_mm} mm tief`,
  inPlane: (what, depth_mm) => `${what}: im Bild, ${depth_mm} mm tief`,
  look: "Aussehen und Label",
};
