/** Poses, programs and frames from elsewhere, in German. */

import type { PoseError } from "../../geometry/pose_files";
import type { Words } from "../en/english";
import type { Translated } from "../translated";

const SUFFIXES = ".json, .npy, .csv, .tum, .txt, .mha, .mhd";

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

function poseError(error: PoseError): string {
  if (error.line !== null) return `Zeile ${error.line}: ${fault(error)}`;
  if (error.pose !== null) return `Lage ${error.pose}: ${fault(error)}`;
  return fault(error);
}

export const connect: Translated<Words["connect"]> = {
  confidence: {
    title: "Verlässlichkeit",
    tones: { good: "Gut belegt", warn: "Teils geraten", bad: "Geraten" },
    warnings: {
      good: "",
      warn: "Der Trainings-Sweep zeigt das nur zum Teil",
      bad: "Der Trainings-Sweep hat das nicht gezeigt",
    },
    waiting: "Sie kommt mit dem ersten Bild.",
    notTold: "Nicht bekannt: Die Szene sagt nicht, woraus sie trainiert wurde.",
    similarity: "Erwartete Ähnlichkeit",
    similarityMeans: (good: number, warn: number) =>
      `Wie ähnlich ein echtes Bild diesem voraussichtlich wäre (MS-SSIM): ab ${good} % gut belegt, unter ${warn} % geraten`,
    error: "Mittlerer Fehler davon",
    errorMeans: (views: number) => `Um so viel lag der Wert im Mittel daneben, auf ${views} Bildern, an denen er geprüft wurde`,
    points: (value: number) => `${value} ${value === 1 ? "Punkt" : "Punkte"}`,
    distance: "Zu den Trainingsbildern",
    support: "Belegte Pixel",
    supportMeans: "Pixel, für die die Szene Gewebe hat (Abdeckung von mindestens 0,3)",
    touch: "Kontakt mit der Haut",
    touchMeans: "Anteil der Scanlinien, deren Fläche auf der Haut liegt; die anderen sind dunkel",
    contact: (percent: number) => `Kontakt ${percent} %`,
    expected: (percent: number) => `erwartete Ähnlichkeit ${percent} %`,
    withError: (percent: number, points: number) =>
      `erwartete Ähnlichkeit ${percent} %, mittlerer Fehler ${points} ${points === 1 ? "Punkt" : "Punkte"}`,
    away: (mm: string, degrees: string) => `${mm} mm und ${degrees}° von den Trainingsbildern`,
    advice: "„Zum nächsten“ führt zum nächsten Bild des Trainings-Sweeps.",
    black: "Schwarz, wo nichts belegt ist",
    blackMeans: "Pixel mit einer Abdeckung unter 0,3 sind schwarz",
    noModel: "Diese Szene wurde ohne Verlässlichkeit trainiert",
    hatch: "Schraffiert, wo nichts belegt ist",
    hatchMeans: "In geratenen Bildern: Pixel mit einer Abdeckung unter 0,3 bekommen schräge Linien. In Bildern des Sweeps sind sie Flüssigkeit oder Schatten",
    uncertainty: "Unsicherheit zeigen",
    uncertaintyMeans: "Der zu erwartende Fehler jedes Pixels, von keinem bis zu einem Viertel des Wegs von Schwarz nach Weiß",
    noUncertainty: "Diese Szene kennt die Unsicherheit ihrer Pixel nicht",
    scale: "Zu erwartender Fehler",
    strip: (least: number, place: number) => `Verlässlichkeit entlang der Lagen: am niedrigsten mit ${least} % bei ${place}`,
    stripUnknown: "Verlässlichkeit entlang der Lagen nicht bekannt",
  },
  pose: {
    title: "Lage",
    home: "Mitte",
    homeMeans: "Zur Mitte des Sweeps",
    snap: "Zum nächsten",
    snapMeans: "Zum nächsten Trainingsbild",
    mark: "Merken",
    markMeans: "Diese Lage merken, um andere dagegen anzugeben",
    frozen: "des Standbilds",
    frozenMeans: "Das Bild steht. Um den Schallkopf zu bewegen, das Standbild aufheben.",
    told: "Angegeben",
    references: {
      absolute: "Absolut, in der Szene",
      relativeScene: "Relativ, entlang der Achsen der Szene",
      relativeProbe: "Relativ, entlang der Achsen des Schallkopfs",
    },
    against: "von",
    againstHome: "der Mitte",
    againstMark: "der gemerkten Lage",
    positionOf: (axis: string) => `Ort ${axis}`,
    absolutePosition: "Ort in der Szene",
    absoluteAngles: "Winkel gegen die Achsen der Szene",
    relativePosition: (other: string) => `Weg von ${other}`,
    relativeAngles: (other: string) => `Drehung gegenüber ${other}`,
    along: { lateral: "Lateral", elevation: "Elevation", axial: "Axial" },
    turns: { tilt: "Kippen", rock: "Wippen", rotate: "Drehen" },
    turnsMean: {
      tilt: "Kippen, um die laterale Achse",
      rock: "Wippen, um die Elevationsachse",
      rotate: "Drehen, um die axiale Achse",
    },
    beyond: (name: string, value: string, low: number, high: number) =>
      `${name} ${value} mm liegt außerhalb der Szene (${low} bis ${high} mm). Dort ist nichts zu sehen.`,
    tooFar: (name: string, most: number) => `${name} darf höchstens ${most} mm in jede Richtung betragen. Es blieb, wie es war.`,
    wrapped: (name: string, typed: string, shown: string) => `${name} ${typed}° ist dieselbe Ausrichtung wie ${shown}.`,
    noNumber: (name: string) => `${name} muss eine Zahl sein. Es blieb, wie es war.`,
    form: "Form der Lage",
    forms: {
      json: "JSON",
      matrix: "Matrix",
      quaternion: "Quaternion",
      euler: "Euler-Winkel",
      numpy: "NumPy",
      ros: "ROS",
    },
    formUnits: {
      json: "Wie die API sie nimmt, mm",
      matrix: "Schallkopf zu Szene, Zeile für Zeile, mm",
      quaternion: "x y z in mm, dann w x y z",
      euler: "x y z in mm, dann Kippen, Wippen und Drehen in Grad, gegen die Achsen der Szene",
      numpy: "Schallkopf zu Szene, mm",
      ros: "geometry_msgs/Pose, Meter",
    },
    textLabel: (form: string) => `Lage als ${form}, Eingabe übernimmt`,
    copy: (form: string) => `Lage als ${form} kopieren`,
    copied: "Kopiert",
    noCopy: "Dieser Browser lässt die Seite nicht kopieren. Der Text ist ausgewählt: Strg+C drücken.",
    gamepad: (name: string) => `Gamepad: ${name}`,
    steering: "Steuern mit Tastatur und Gamepad",
    slide: "Schieben",
    turn: "Drehen",
    finely: "Fein",
    pad: "Gamepad",
    slides: { lateral: "lateral", elevation: "Elevation", axial: "axial" },
    turnKeys: "dasselbe mit {Shift}: drehen, kippen, wippen",
    fineKeys: "mit {Alt}",
    padKeys: "linker Stick und Trigger schieben, rechter Stick und Schultertasten drehen",
  },
  poseError,
  path: {
    title: "Weg des Schallkopfs",
    playback: "Abspielen",
    play: "Sweep abspielen",
    pause: "Sweep anhalten",
    inSweep: "Stelle im Trainings-Sweep",
    inPath: (name: string) => `Stelle in ${name}`,
    noSweep: "kein Trainings-Sweep",
    viewOf: (place: number, count: number) => `Bild ${place} von ${count}`,
    poseOf: (place: number, count: number) => `Lage ${place} von ${count}`,
    besideViews: "neben den Bildern",
    besidePoses: "neben den Lagen",
    backToSweep: "Zurück zum Trainings-Sweep",
    load: "Lagen laden",
    loadMeans: "JSON, NumPy (.npy), CSV, TUM oder der Kopf einer PLUS-Sequenz (.igs.mha)",
    file: "Datei mit Lagen",
    tooLarge: "Sie ist größer als 64 MiB.",
    wrong: (file: string, problem: string) => `${file}: ${problem}`,
    readAs: { mm: "als Millimeter gelesen", m: "als Meter gelesen" },
    unitGuessed: "die Datei nennt ihre Einheit nicht",
    unit: "Einheit der Datei",
    units: { mm: "mm", m: "m" },
    transform: "Transformation",
    skipped: (count: number) => `${count} ${count === 1 ? "Bild" : "Bilder"} ohne gültige Lage ausgelassen`,
    record: "Aufzeichnen",
    stop: "Aufzeichnung beenden",
    recording: (seconds: string, count: number) => `${seconds} s, ${count} Lagen`,
    full: "Die Aufzeichnung hat ihre Grenze von 100 000 Lagen erreicht und wurde beendet.",
    recorded: (number: number) => `Aufzeichnung ${number}`,
    none: "Zeichnen Sie auf, was der Schallkopf tut, oder laden Sie Lagen. Sie lassen sich dann abspielen, speichern und als Datensatz rendern.",
    summary: (count: number, seconds: string | null, mm: string) =>
      `${count} Lagen, ${mm} mm lang${seconds === null ? "" : `, ${seconds} s`}`,
    save: "Lagen speichern",
    render: "Als Datensatz rendern",
    renderMeans: "Jede Lage wird im Hintergrund zu einem Bild, mit den Bildeinstellungen von jetzt",
    format: "Format des Datensatzes",
    progress: (done: number, all: number) => `${done} von ${all} Bildern`,
    states: { queued: "Wartet", running: "Wird gerendert", succeeded: "Fertig", failed: "Gescheitert", cancelled: "Abgebrochen" },
    cancel: "Abbrechen",
    download: (name: string) => `${name} herunterladen`,
    may: (who: string) => `Nur ${who} dürfen Aufträge starten.`,
  },
  connection: {
    title: "Verbinden",
    language: "Sprache des Beispiels",
    languages: { curl: "curl", python: "Python", grpc: "gRPC", websocket: "WebSocket", igtl: "OpenIGTLink", ros: "ROS 2" },
    needs: {
      curl: "Speichert ein Bild als frame.png.",
      python: "Braucht das Paket ultragray-client.",
      grpc: "Braucht grpcurl. Der Dienst beschreibt seine Nachrichten selbst.",
      websocket: "Braucht die Pakete websockets und numpy. Für Livebilder eines bewegten Schallkopfs.",
      igtl: "Braucht das Paket pyigtl. Ein Gerät mit dem Namen der Szene bekommt deren Bilder.",
      ros: "Braucht ROS 2 und das Paket ultragray-ros. Lagen kommen auf /ultragray/probe_pose herein, in Metern, Bilder gehen auf /ultragray/bmode hinaus.",
    },
    intro: "Das Bild von jetzt, von einem Programm angefordert:",
    copy: (language: string) => `Beispiel in ${language} kopieren`,
    copied: "Kopiert",
    copyShort: "Kopieren",
    selected: "Dieser Browser lässt die Seite nicht kopieren. Der Text ist ausgewählt: Strg+C drücken.",
    off: "Dieser Dienst hat keinen Port für OpenIGTLink. Wer ihn betreibt, kann einen öffnen.",
    registered: (name) => `Die Lage ist die des Flansches zur Basis; der Dienst führt sie mit ${name} in die Szene.`,
    notRegistered: "Die Lage ist die des Schallkopfs in der Szene; eine Verbindung über OpenIGTLink nennt eine Registrierung mit dem Parameter Registration.",
    localOnly: "OpenIGTLink antwortet nur Programmen auf dem Rechner des Dienstes.",
    ports: "Steht ein Proxy vor dem Dienst, kann sein gRPC-Port ein anderer sein.",
    key: "Setzen Sie Ihren API-Schlüssel an die Stelle von YOUR_KEY.",
    unknown: "Der Dienst nennt seine Ports nicht.",
    streams: "Offene Streams",
    noStreams: "Kein anderes Programm hat einen Stream dieser Szene offen.",
    streamsHere: "Die des Dienstes, der dieser Seite antwortet; hinter einem Proxy kann es weitere geben.",
    follow: "Folgen",
    followOf: (name: string) => `${name} folgen`,
    unfollow: "Nicht mehr folgen",
    following: (name: string) => `Folgt ${name}`,
    followed: "Bild, Schallkopf und Lage sind die, die dieses Programm anfordert. Wer den Schallkopf selbst bewegt, beendet das.",
    renderedHere: "Die Bilder dieses Programms kann keine Seite zeigen: Dieselben Lagen werden hier gerendert.",
    elsewhere: (scene: string) => `Es fordert jetzt eine andere Szene an: ${scene}.`,
    ended: (name: string) => `${name} hat den Stream geschlossen.`,
    lost: "Die Verbindung zum Stream ist verloren. Sie wird wieder versucht.",
    steered: (name: string) => `Sie haben den Schallkopf bewegt: ${name} wird nicht mehr gefolgt.`,
    unnamed: "Ein Programm",
    page: "Eine andere Seite der Konsole",
    door: { websocket: "WebSocket", grpc: "gRPC", openigtlink: "OpenIGTLink" },
    rate: (poses: string, frames: string) => `${poses} Lagen/s, ${frames} Bilder/s`,
    idle: (time: string) => `still seit ${time}`,
    age: (time: string) => `offen seit ${time}`,
    dropped: (count: number) => `${count} durch neuere ersetzt`,
    readout: "Latenz auf dem Bild",
    readoutMeans: "Zeiten, Alter und Verluste der Bilder, in der Ecke des Bilds",
    latency: (p50: string, p99: string) => `Latenz ${p50} ms, 99 % unter ${p99} ms`,
    asSeen: (queue: string, render: string) => `${queue} ms gewartet, in ${render} ms gerendert`,
    frameAge: (time: string) => `Alter des Bilds ${time}`,
    losses: (count: number) => `${count} Lagen durch neuere ersetzt`,
    version: "Version",
    renderer: "Renderer",
    docs: "Dokumentation der API",
    waiting: "…",
  },
};

export const locate: Translated<Words["locate"]> = {
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

export const registrations: Translated<Words["registrations"]> = {
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
