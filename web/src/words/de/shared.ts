/** What parts that several views use say, in German. */

import type { Words } from "../en/english";

const written = (value: number): string => String(value).replace(".", ",");

function limits(least: number, most: number, unit: string): string {
  const mm = unit && ` ${unit}`;
  if (Number.isFinite(least) && Number.isFinite(most)) return `eine Zahl von ${written(least)} bis ${written(most)}${mm}`;
  if (Number.isFinite(least)) return `eine Zahl ab ${written(least)}${mm}`;
  return Number.isFinite(most) ? `eine Zahl bis ${written(most)}${mm}` : "eine Zahl";
}

const labels: Words["shared"]["field"]["labels"] = {
  baselines: "Klassische Verfahren",
  below_min_confidence: "Darunter",
  brightness: "Helligkeit",
  budget: "Aufwand",
  contact: "Abseits der Haut",
  convex: "Konvex",
  count: "Anzahl",
  crop: "Ausschnitt",
  dataset: "Sweep",
  device: "Gerät",
  diameter_mm: "Durchmesser",
  dtype: "Zahlen als",
  fan: "Fächer",
  far_mm: "Ende",
  format: "Format",
  frames: "Bilder",
  histogram_distance: "Histogramm-Abstand",
  height: "Tiefenpunkte",
  image_size: "Bildgröße",
  kind: "Art",
  label: "Label",
  linear: "Linear",
  max_run_s: "Längste Laufzeit",
  methods: "Verfahren",
  min_confidence: "Kleinste Konfidenz",
  min_memory_gb: "Kleinster Speicher",
  near_mm: "Beginn",
  opacity: "Deckung",
  opening_angle_deg: "Öffnungswinkel",
  phased: "Phased Array",
  radial: "Radial",
  reverberation: "Kometenschweif",
  rotation_deg: "Drehung",
  roughness: "Rauheit",
  scene: "Szene",
  seed: "Startwert",
  shard_frames: "Bilder in einer Datei",
  slice_thickness_mm: "Schichtdicke",
  spacing_mm: "Abstand",
  steered: "Linear, geschwenkt",
  steering_deg: "Schwenkwinkel",
  step_deg: "Schrittweite",
  tilt_deg: "Kippung",
  times: "Vielfaches der Zeit",
  train_frames: "Bilder zum Trainieren",
  transform: "Transformation",
  translation_mm: "Verschiebung",
  val_frames: "Zurückgehaltene Bilder",
  width: "Scanlinien",
  width_mm: "Breite",
};

export const shared: Words["shared"] = {
  chart: (title, unit, x, series) => `${title}${unit && ` in ${unit}`} über ${x}: ${series.join(", ")}`,
  nameValue: (line) => `„${line}“ muss als Name = Wert geschrieben sein.`,
  metrics: "Maße",
  better: (higher: boolean): string => (higher ? "höher ist besser" : "niedriger ist besser"),
  slider: {
    value: "Wert",
    outside: (least, most, unit) => `Hier passt nur ${limits(least, most, unit)}.`,
    reset: (value, unit) => `Doppelklick: ${written(value)}${unit && ` ${unit}`}`,
  },
  field: {
    ofList: (label, place, count) => `${label} ${place} von ${count}`,
    labels,
  },
  only: (who, what) => `Nur ${who} dürfen ${what}.`,
  keep: "Behalten",
  fetching: "Wird geholt …",
  loading: "Lädt",
  you: "Sie",
  private: "privat",
  privateTo: (owner) => `Nur ${owner === null ? "" : `${owner} und `}Verwalter sehen das`,
  privateChoice: "Privat",
  privateMeans: "nur Sie und Verwalter sehen es",
};
