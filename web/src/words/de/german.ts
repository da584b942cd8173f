/** The German catalogue: the texts of german.json, and here the sentences that more than their words make.
 *
 * In a text, {0} stands for what the English sentence is given first. What is in neither is shown in English.
 */

import type { PoseError } from "../../geometry/pose_files";
import type { Words } from "../en/english";
import { translated, type Translated } from "../translated";
import texts from "./german.json";

const SUFFIXES = ".json, .npy, .csv, .tum, .txt, .mha, .mhd";
const PLURALS = { reader: "Leser", operator: "Bediener", admin: "Verwalter" };
const MARKS: Record<string, string> = { distance: "Strecke", ellipse: "Ellipse", angle: "Winkel", text: "Text" };

const written = (value: number): string => String(value).replace(".", ",");
const points = (count: number): string => `${count} ${count === 1 ? "Punkt" : "Punkte"}`;

const sentences: Translated<Words> = {
  connect: {
    confidence: {
      points,
      withError: (percent, error) => `erwartete Ähnlichkeit ${percent} %, mittlerer Fehler ${points(error)}`,
    },
    path: {
      skipped: (count) => `${count} ${count === 1 ? "Bild" : "Bilder"} ohne gültige Lage ausgelassen`,
      summary: (count, seconds, mm) => `${count} Lagen, ${mm} mm lang${seconds === null ? "" : `, ${seconds} s`}`,
    },
    poseError: (error) => {
      if (error.line !== null) return `Zeile ${error.line}: ${fault(error)}`;
      return error.pose === null ? fault(error) : `Lage ${error.pose}: ${fault(error)}`;
    },
  },
  registrations: {
    references: (name) => ({
      absolute: `Absolut, wie ${name} es angibt`,
      relativeScene: `Relativ, entlang der Achsen von ${name}`,
      relativeProbe: "Relativ, entlang der Achsen des Flansches",
    }),
    gone: (name, scene) =>
      `${name} ${scene === null ? "ist nicht mehr gespeichert" : `gehört jetzt zur Szene ${scene}`}: Lagen sind wieder die des Schallkopfs.`,
  },
  scan: {
    image: { live: (perSecond) => (perSecond < 1 ? "Live" : `Live, ${perSecond.toFixed(0)} Bilder/s`) },
    marks: {
      handle: (letter, kind, point) =>
        `${letter}, ${MARKS[kind]}, Punkt ${point}: mit den Pfeiltasten verschieben, mit Umschalt schneller, Entf entfernt die Messung`,
    },
    results: { ellipse: ({ axes, circumference, area }) => `${axes}, Umfang ${circumference}, Fläche ${area}` },
    store: { slice: (thickness_mm) => `Schicht ${thickness_mm.toFixed(1).replace(".", ",")} mm` },
    display: { trained: (thickness_mm) => `Wie trainiert: ${thickness_mm.toFixed(1).replace(".", ",")} mm.` },
  },
  scenes: { audit: { span: (hours) => (hours === 1 ? "eine Stunde" : hours === 24 ? "ein Tag" : `${hours / 24} Tage`) } },
  session: {
    link: {
      refused: (values) =>
        `Die Adresse enthält ${values.length === 1 ? "einen Wert, der nicht verwendbar ist" : "Werte, die nicht verwendbar sind"}; ohne sie geöffnet: ${values.join(", ")}.`,
      oneOf: (choices) => `eines von ${choices.join(", ")}`,
    },
  },
  shared: {
    chart: (title, unit, x, series) => `${title}${unit && ` in ${unit}`} über ${x}: ${series.join(", ")}`,
    better: (higher) => (higher ? "höher ist besser" : "niedriger ist besser"),
    slider: {
      outside: (least, most, unit) => `Hier passt nur ${limits(least, most, unit)}.`,
      reset: (value, unit) => `Doppelklick: ${written(value)}${unit && ` ${unit}`}`,
    },
    privateTo: (owner) => `Nur ${owner === null ? "" : `${owner} und `}Verwalter sehen das`,
  },
  shell: {
    key: { allowed: (who, owner) => [...(owner === null ? [] : [owner]), ...who.map((role) => PLURALS[role])].join(" und ") },
  },
  space: { pressed: (depth_mm) => `${depth_mm.toFixed(1).replace(".", ",")} mm eingedrückt` },
  tools: { advance: (by_mm) => (by_mm > 0 ? `Um ${by_mm} mm vorschieben` : `Um ${-by_mm} mm zurückziehen`) },
  train: {
    frames: (count, isPrivate) => `${count} Bilder${isPrivate ? ", privat" : ""}`,
    dataset: { warnings: (count) => (count === 1 ? "1 Warnung" : `${count} Warnungen`) },
  },
};

export const german = translated<object>(texts, sentences);

function limits(least: number, most: number, unit: string): string {
  const mm = unit && ` ${unit}`;
  if (Number.isFinite(least) && Number.isFinite(most)) return `eine Zahl von ${written(least)} bis ${written(most)}${mm}`;
  if (Number.isFinite(least)) return `eine Zahl ab ${written(least)}${mm}`;
  return Number.isFinite(most) ? `eine Zahl bis ${written(most)}${mm}` : "eine Zahl";
}

function fault({ fault: found }: PoseError): string {
  switch (found.kind) {
    case "json":
      return `Das ist kein JSON, das die Konsole kennt: Eine Lage ist ein Objekt mit position_mm und quaternion oder mit matrix (${found.problem}).`;
    case "jsonNumbers":
      return `${found.key} braucht die Zahlen ${found.names.join(", ")}.`;
    case "empty":
      return "Darin sind keine Lagen.";
    case "tooMany":
      return `Höchstens ${found.most} Lagen sind möglich, hier sind es ${found.count}.`;
    case "suffix":
      return `Dateien dieser Art (${found.suffix || "ohne Endung"}) werden nicht gelesen, sondern: ${SUFFIXES}.`;
    case "count":
      return `${found.found} Zahlen gefunden, ${found.expected.replace(", ", " oder ")} erwartet.`;
    case "number":
      return `„${found.text}“ ist keine Zahl.`;
    case "quaternion":
      return `Das Quaternion muss die Länge 1 haben; dieses hat ${found.length.toFixed(3).replace(".", ",")}.`;
    case "rotation":
      return found.mirrors
        ? "Die Matrix muss eine Drehung enthalten; diese spiegelt."
        : "Die Matrix muss eine Drehung enthalten: Achsen der Länge 1 im rechten Winkel.";
    case "lastRow":
      return "Die Matrix muss mit der Zeile 0 0 0 1 enden; die Verschiebung ist ihre letzte Spalte.";
    case "ros":
      return `Eine Lage in ROS hat position und orientation; ${found.missing} fehlt.`;
    case "npy":
      return found.problem === "magic" ? "Diese Datei hat nicht NumPy geschrieben." : "Die Datei endet vor ihrer letzten Lage.";
    case "npyType":
      return `Die Zahlen haben in NumPy den Typ ${found.type}; erwartet wird float32 oder float64.`;
    case "npyShape":
      return `Das Feld hat die Form ${found.shape}; erwartet wird (N, 4, 4), auch (N, 3, 4), (N, 12) oder (N, 16).`;
    case "csvHeader":
      return `Die Spalten ${found.missing.join(", ")} fehlen.`;
    case "plusHeader":
      return "Darin sind keine Transformationen von Bildern (Zeilen wie Seq_Frame0000_ProbeToReferenceTransform).";
    case "plusTransforms":
      return `Keine der Transformationen kann die Lage eines Schallkopfs sein: ${found.found.join(", ")} enthalten die Größe der Pixel oder wurden nie erfasst.`;
  }
}
