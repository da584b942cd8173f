/** Where a real frame was taken, in German. */

import type { Words } from "../en/english";

export const locate: Words["locate"] = {
  title: "Wo entstand dieses Bild?",
  label: "Wo ein echtes Bild entstand",
  choose: "Ein Bild wählen",
  chooseHint: "PNG, wie das Gerät es speichert: eine Spalte je Scanlinie, nicht scankonvertiert",
  size: (width, height) => `${width} × ${height} Pixel; hier ein anderes wählen`,
  notPng: (name) => `${name} ist keine PNG-Datei.`,
  damaged: (name) => `${name} ist beschädigt: Es lässt sich nicht als Bild zeigen.`,
  scanConverted:
    "Das sieht nach einem Bild vom Schirm aus: ein Fächer auf schwarzem Grund. So wird es kaum gefunden. Gebraucht wird das Bild vor der Scankonversion, Zeilen entlang der Tiefe, eine Spalte je Scanlinie.",
  within: { within_mm: "Versatz", within_deg: "Drehung" },
  withinMeans: {
    within_mm: "Wie weit der Schallkopf daneben liegen darf, mm",
    within_deg: "Um welchen Winkel der Schallkopf verdreht sein darf",
  },
  search: "Suchen",
  searchMeans: "Das Bild um die jetzige Lage des Schallkopfs herum suchen",
  fromHere: "von der jetzigen Lage aus",
  searching: "Wird gesucht …",
  rendering: "Das Bild von dort entsteht …",
  stop: "Anhalten",
  found: "Gefunden.",
  notFound:
    "Nicht gefunden. Den Schallkopf näher an die Stelle bringen, mehr Abweichung erlauben oder prüfen, ob Bild, Schallkopf und Szene zusammengehören.",
  similarity: "Ähnlichkeit",
  similarityMeans: "Korrelation der Strukturen des Bilds und der Szene dort, -1 bis 1; am richtigen Ort mehr als die Hälfte",
  positionStd: "Position ±",
  positionStdMeans: "Standardabweichungen entlang der lateralen, Elevations- und axialen Achse des Schallkopfs",
  angleStd: "Winkel ±",
  angleStdMeans: "Standardabweichungen um die laterale, Elevations- und axiale Achse",
  fromStart: "Vom Start aus",
  took: "Dauer der Suche",
  seconds: (amount) => `${amount} s`,
  take: "Dorthin",
  takeMeans: "Nimmt die gefundene Lage als die des Schallkopfs",
  frozen: "Das Bild ist eingefroren. Erst weiterlaufen lassen (F).",
  pictures: "Wie beide Bilder gezeigt werden",
  side: "Nebeneinander",
  blend: "Überblenden",
  given: "Gegeben",
  rendered: "Gerendert",
  shareOfRendered: "Anteil des gerenderten Bilds",
};
