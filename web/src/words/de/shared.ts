/** What parts that several views use say, in German. */

import type { Words } from "../en/english";

function limits(least: number, most: number, unit: string): string {
  const mm = unit && ` ${unit}`;
  if (Number.isFinite(least) && Number.isFinite(most)) return `eine Zahl von ${least} bis ${most}${mm}`;
  if (Number.isFinite(least)) return `eine Zahl ab ${least}${mm}`;
  return Number.isFinite(most) ? `eine Zahl bis ${most}${mm}` : "eine Zahl";
}

export const shared: Words["shared"] = {
  slider: {
    value: "Wert",
    outside: (least, most, unit) => `Hier passt nur ${limits(least, most, unit)}.`,
    reset: (value, unit) => `Doppelklick: ${value}${unit && ` ${unit}`}`,
  },
  field: {
    ofList: (label, place, count) => `${label} ${place} von ${count}`,
  },
  confidence: {
    title: "Verlässlichkeit",
    later: "Sie kommt mit dem ersten Bild.",
    unknown: "Nicht bekannt: Die Szene sagt nicht, woraus sie trainiert wurde.",
    similarity: "Erwartete Ähnlichkeit",
    similarityMeans: (good, warn) => `Mit einem echten Bild an dieser Stelle (MS-SSIM): ab ${good} gut gestützt, unter ${warn} geraten`,
    range: (low, high) => `(${low.replace(" %", "")} bis ${high})`,
    rangeMeans: (views) => `Mittlerer Fehler auf den ${views} Bildern, an denen die Zahl angepasst wurde`,
    distance: "Zu Trainingsbildern",
    support: "Gestützte Bildpunkte",
    supportMeans: "Abdeckung von mindestens 0,3",
    unseen: "Der Trainingssweep zeigte das nicht. „Snap“ unter Schallen geht zu seinem nächsten Bild.",
    black: "Schwarz, wo nichts stützt",
    blackMeans: "Abdeckung unter 0,3 wird schwarz",
    notThere: "Diese Szene wurde ohne Verlässlichkeit trainiert",
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
