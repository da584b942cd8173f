/** The German catalogue: the texts of german.json, and here the sentences that more than their words make.
 *
 * In a text, {0} stands for what the English sentence is given first. What is in neither is shown in English.
 */

import { POSE_SUFFIXES } from "../../geometry/pose_files";
import type { Words } from "../en/english";
import { translated, type Translated } from "../translated";
import texts from "./german.json";

const PLURALS = { reader: "Leser", operator: "Bediener", admin: "Verwalter" };
const MARKS: Record<string, string> = { distance: "Strecke", ellipse: "Ellipse", angle: "Winkel", text: "Text" };

const written = (value: number): string => String(value).replace(".", ",");
const points = (count: number): string => `${count} ${count === 1 ? "Prozentpunkt" : "Prozentpunkte"}`;

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
    poseError: {
      faults: {
        suffix: (suffix) =>
          `Dateien dieser Art (${suffix || "ohne Endung"}) werden nicht gelesen, sondern: ${POSE_SUFFIXES.join(", ")}.`,
        count: (found, expected) => `${found} Zahlen gefunden, ${expected.replace(", ", " oder ")} erwartet.`,
        quaternion: (length) =>
          `Das Quaternion muss die Länge 1 haben; dieses hat ${length.toFixed(3).replace(".", ",")}.`,
      },
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
  },
  labels: {
    state: (frames, made) =>
      made === null ? "Noch ist nichts gespeichert." : `${frames === 1 ? "Ein Bild" : `${frames} Bilder`} angemalt, gespeichert als ${made}.`,
  },
  scenes: { audit: { span: (hours) => (hours === 1 ? "eine Stunde" : hours === 24 ? "ein Tag" : `${hours / 24} Tage`) } },
  session: {
    local: {
      difference: (largest, mean) =>
        largest === 0
          ? "Ihr Bild ist das des Dienstes, Pixel für Pixel."
          : `Ihr Bild und das des Dienstes unterscheiden sich um höchstens ${largest} von 255 Graustufen, im Mittel um ${mean}.`,
    },
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
