/** The header, the key form and the menu of the key, in German. */

import type { Words } from "../en/english";

export const shell: Words["shell"] = {
  views: {
    scan: "Schallen",
    maps: "Karten",
    compare: "Vergleich",
    train: "Training",
    scenes: "Szenen und Dienst",
  },
  status: {
    asking: "Verbindet",
    ready: "Dienst bereit",
    starting: "Dienst nicht bereit",
    down: "Dienst antwortet nicht",
    locked: "Schlüssel nötig",
  },
  toScan: "UltraG-Ray, zum Schallen",
  viewsLabel: "Ansichten",
  scene: "Szene",
  noScene: "keine",
  lightColours: "Helle Farben",
  darkColours: "Dunkle Farben",
  language: "Sprache",
  noScenes: "Noch keine Szenen.",
  trainOne: "Eine aus einem Sweep trainieren",
  or: "oder",
  importOne: "eine Szenendatei einlesen",
  serviceDown: "Der Dienst antwortet nicht. Jede Sekunde wird es wieder versucht.",
  notLoaded: "Dieser Teil der Konsole konnte nicht geladen werden.",
  tryAgain: "Noch einmal",
  key: {
    asked: "Dieser Dienst verlangt einen Schlüssel",
    kept: "Er bleibt nur in diesem Tab, bis der Tab geschlossen wird.",
    label: "API-Schlüssel",
    open: "Öffnen",
    odd: "Ein Schlüssel besteht aus einfachen Buchstaben, Ziffern und Zeichen; dieser hat andere (ein typografischer Strich, ein Anführungszeichen?).",
    refused: "Der Dienst nimmt diesen Schlüssel nicht an.",
    yours: "Ihr Schlüssel",
    name: "Name",
    role: "Rolle",
    expires: "Läuft ab",
    never: "nie",
    another: "Einen anderen Schlüssel nehmen",
    roles: { reader: "Leser", operator: "Bediener", admin: "Verwalter" },
    may: {
      reader: "Sie dürfen ansehen, rendern und streamen.",
      operator: "Sie dürfen auch Aufträge starten, Sweeps und Szenen hinzufügen und löschen, was Ihnen gehört.",
      admin: "Sie dürfen alles, auch mit dem, was anderen gehört.",
    },
  },
};
