/** Registrations of robots and trackers, in German. */

import type { Words } from "../en/english";

export const registrations: Words["registrations"] = {
  title: "Registrierungen",
  none: "Keine gespeichert. Eine Registrierung sagt, wie die Lagen eines Roboters oder Trackers in eine Szene führen: ultragray calibrate findet sie.",
  meaning: "Lagen werden gezeigt und getippt",
  inScene: "des Schallkopfs, in der Szene",
  into: (scene) => `nach ${scene}`,
  residual: (amounts) => `Restfehler ${amounts}`,
  residualMeans: "Quadratisches Mittel dessen, was beim Bestimmen übrig blieb",
  noResidual: "Restfehler unbekannt",
  references: (name) => ({
    absolute: `Absolut, wie ${name} es angibt`,
    relativeScene: `Relativ, entlang der Achsen von ${name}`,
    relativeProbe: "Relativ, entlang der Achsen des Flansches",
  }),
  position: (name) => `Ort des Flansches, wie ${name} ihn angibt`,
  angles: (name) => `Winkel gegen die Achsen von ${name}`,
  about: (axis) => `Um ${axis}`,
  form: (name) => `Flansch zu Basis, wie ${name} sie angibt`,
  gone: (name, scene) =>
    `${name} ${scene === null ? "ist nicht mehr gespeichert" : `gehört jetzt zur Szene ${scene}`}: Lagen sind wieder die des Schallkopfs.`,
  tag: (name) => `nach ${name}`,
  tagMeans: "Lagen werden nach dieser Registrierung angegeben; gewählt unten bei den Registrierungen",
};
