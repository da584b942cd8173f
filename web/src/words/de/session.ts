/** A scene as it is scanned: what stands in its way, what an address tells, in German. */

import type { Words } from "../en/english";

export const session: Words["session"] = {
  link: {
    refused: (values) =>
      `Die Adresse enthält ${values.length === 1 ? "einen Wert, der nicht verwendbar ist" : "Werte, die nicht verwendbar sind"}; ohne sie geöffnet: ${values.join(", ")}.`,
    pose: "sieben Zahlen: x, y, z, w, i, j, k",
    quaternion: "das Quaternion muss die Länge 1 haben",
    number: "keine Zahl",
    count: (count) => `${count} Zahlen`,
    within: (low, high) => `${low} bis ${high}`,
    oneOf: (choices) => `eines von ${choices.join(", ")}`,
  },
  notice: {
    missing: (scene) => `Hier gibt es keine Szene ${scene}.`,
    thereAre: () => "Es gibt",
    unreadable: (detail) => `Diese Szenendatei lässt sich nicht lesen: ${detail}`,
    down: "Der Dienst antwortet nicht. Sobald er es wieder tut, geht das Bild von selbst weiter.",
    barred:
      "Der Dienst antwortet, aber es kommen keine Livebilder an. Etwas zwischen diesem Browser und dem Dienst hält die Liveverbindung auf; wer den Dienst betreibt, kann sie öffnen.",
    barredKey: "Oder mit diesem Schlüssel sind schon so viele Streams offen, wie er darf.",
  },
};
