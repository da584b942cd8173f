/** Maps, in German. */

import type { Words } from "../en/english";

export const maps: Words["maps"] = {
  outputs: {
    bmode: { title: "B-Bild", meaning: "Was ein Gerät zeigt: das Echo mal dem, was vom Schall noch da ist." },
    echo: { title: "Echo", meaning: "Wie stark das Gewebe reflektiert, bevor der Weg dorthin seinen Teil nimmt." },
    transmittance: { title: "Transmission", meaning: "Der Anteil des Schalls, der in dieser Tiefe noch da ist." },
    coverage: { title: "Abdeckung", meaning: "Wie gut Gelerntes den Bildpunkt stützt; unter 0,3 ist er vor allem geraten." },
    attenuation: { title: "Dämpfung", meaning: "Der Anteil des Schalls, der am Bildpunkt ankommt und dort endet." },
    labels: { title: "Gewebe", meaning: "Das Gewebe, das im Bildpunkt am meisten wiegt, oder das Instrument dort." },
    uncertainty: { title: "Unsicherheit", meaning: "Der Fehler, der von der Helligkeit des Bildpunkts zu erwarten ist." },
  },
  group: "Karten; die Pfeiltasten bewegen das Fadenkreuz, mit der Umschalttaste schneller",
  enlarge: (title) => `${title}, groß zeigen`,
  canvas: (title) => `Karte: ${title}`,
  legend: (end) => `Skala von 0 bis ${end}, von dunkel nach hell`,
  noLabel: "keines",
  label: (number) => `Label ${number}`,
  cursor: {
    title: "Fadenkreuz",
    lateral: "Lateral",
    depth: "Tiefe",
    pixel: "Spalte, Zeile",
    hint: "Zeigen Sie auf eine Karte, oder bewegen Sie das Fadenkreuz mit den Pfeiltasten. Ein Klick auf eine kleine Karte macht sie groß. Schraffiert: neben dem Bild, dort ist nichts bekannt.",
  },
  corrections: {
    title: "Korrigierte Lagen",
    meaning: "Wie weit das Training den Schallkopf von dort verschob und drehte, wo der Tracker ihn sah. Ein Klick geht zum Bild.",
    shift: "Verschiebung",
    turn: "Drehung",
    view: "Trainingsbild",
  },
};
