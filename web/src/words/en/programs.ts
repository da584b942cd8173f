/** Poses, programs and frames from elsewhere, in English. */

import type { Reference } from "../../geometry/pose";
import type { PoseError } from "../../geometry/pose_files";
import type { Named } from "../translated";

const SUFFIXES = ".json, .npy, .csv, .tum, .txt, .mha, .mhd";

function fault({ fault: found }: PoseError): string {
  switch (found.kind) {
    case "json":
      return `This is not JSON that the console knows: a pose is an object of position_mm and quaternion, or of matrix (${found.problem}).`;
    case "jsonNumbers":
      return `${found.key} needs the numbers ${found.names.join(", ")}.`;
    case "empty":
      return "There are no poses in it.";
    case "tooMany":
      return `There may be at most ${found.most} poses, and these are ${found.count}.`;
    case "suffix":
      return `Files of this kind (${found.suffix || "without an ending"}) are not read. Read are: ${SUFFIXES}.`;
    case "count":
      return `${found.found} numbers were found; ${found.expected.replace(", ", " or ")} were expected.`;
    case "number":
      return `“${found.text}” is not a number.`;
    case "quaternion":
      return `The quaternion must have length 1; this one has ${found.length.toFixed(3)}.`;
    case "rotation":
      return found.mirrors
        ? "The matrix must hold a rotation; this one mirrors."
        : "The matrix must hold a rotation: axes of length 1 at right angles.";
    case "lastRow":
      return "The matrix must end in the row 0 0 0 1; the translation is its last column.";
    case "ros":
      return `A pose of ROS has a position and an orientation; ${found.missing} was not found.`;
    case "npy":
      return found.problem === "magic" ? "This is not a file that NumPy wrote." : "The file ends before its last pose.";
    case "npyType":
      return `The numbers are of NumPy's type ${found.type}; float32 or float64 was expected.`;
    case "npyShape":
      return `The array has the shape ${found.shape}; (N, 4, 4) was expected, also (N, 3, 4), (N, 12) or (N, 16).`;
    case "csvHeader":
      return `The columns ${found.missing.join(", ")} are missing.`;
    case "plusHeader":
      return "There are no transforms of frames in it (lines such as Seq_Frame0000_ProbeToReferenceTransform).";
    case "plusTransforms":
      return `None of its transforms can be a pose of a probe: ${found.found.join(", ")} hold the size of pixels, or were never tracked.`;
  }
}

/** The place of a fault before the fault itself. */
function poseError(error: PoseError): string {
  const said = fault(error);
  if (error.line !== null) return `Line ${error.line}: ${said}`;
  if (error.pose !== null) return `Pose ${error.pose}: ${said}`;
  return said;
}

export const connect = {
  confidence: {
    title: "Confidence",
    tones: { good: "Well supported", warn: "Partly a guess", bad: "A guess" },
    warnings: {
      good: "",
      warn: "The training sweep shows this only in part",
      bad: "The training sweep did not show this",
    },
    waiting: "Shown with the first frame.",
    notTold: "Not known: the scene does not tell what it was trained from.",
    similarity: "Expected similarity",
    similarityMeans: (good: number, warn: number) =>
      `How similar a real image is expected to be to this one (MS-SSIM): from ${good} % on well supported, below ${warn} % a guess`,
    error: "Mean error of the estimate",
    errorMeans: (views: number) => `How far the figure was off, on average, on ${views} views that it was tested on`,
    points: (value: number) => `${value} points`,
    distance: "To training views",
    support: "Pixels with support",
    supportMeans: "Pixels for which the scene holds tissue (coverage of at least 0.3)",
    touch: "Contact with the skin",
    touchMeans: "Share of the scan lines whose face is on the skin; the others are dark",
    contact: (percent: number) => `contact ${percent} %`,
    expected: (percent: number) => `expected similarity ${percent} %`,
    withError: (percent: number, points: number) => `expected similarity ${percent} %, mean error ${points} points`,
    away: (mm: string, degrees: string) => `${mm} mm and ${degrees}° from the training views`,
    advice: "Snap goes to the nearest view of the training sweep.",
    black: "Black where nothing supports it",
    blackMeans: "Pixels with coverage below 0.3 are black",
    noModel: "This scene was trained without confidence",
    hatch: "Hatch where nothing supports it",
    hatchMeans: "Of a guess: pixels with coverage below 0.3 get diagonal lines. In a view that the sweep shows, they are fluid or shadow",
    uncertainty: "Show uncertainty",
    uncertaintyMeans: "The error to expect of each pixel, from none to a quarter of the way from black to white",
    noUncertainty: "This scene does not know the uncertainty of its pixels",
    scale: "Expected error",
    strip: (least: number, place: number) => `Confidence along the poses: lowest ${least} % at ${place}`,
    stripUnknown: "Confidence along the poses is not known",
  },
  pose: {
    title: "Pose",
    home: "Home",
    homeMeans: "To the middle of the sweep",
    snap: "Snap",
    snapMeans: "To the nearest training view",
    mark: "Mark",
    markMeans: "Remember this pose, to tell others against it",
    frozen: "of the frozen image",
    frozenMeans: "The image is frozen. Unfreeze it to move the probe.",
    told: "Shown as",
    references: {
      absolute: "Absolute, in the scene",
      relativeScene: "Relative, along the scene's axes",
      relativeProbe: "Relative, along the probe's axes",
    },
    against: "from",
    againstHome: "Home",
    againstMark: "the mark",
    positionOf: (axis: string) => `Position ${axis}`,
    absolutePosition: "Position in the scene",
    absoluteAngles: "Angles against the scene's axes",
    relativePosition: (other: string) => `Way from ${other}`,
    relativeAngles: (other: string) => `Turn against ${other}`,
    along: { lateral: "Lateral", elevation: "Elevation", axial: "Axial" },
    turns: { tilt: "Tilt", rock: "Rock", rotate: "Rotate" },
    turnsMean: {
      tilt: "Tilt, about the lateral axis",
      rock: "Rock, about the elevation axis",
      rotate: "Rotate, about the axial axis",
    },
    beyond: (name: string, value: string, low: number, high: number) =>
      `${name} ${value} mm lies outside of the scene (${low} to ${high} mm). There is nothing to see there.`,
    tooFar: (name: string, most: number) => `${name} may be at most ${most} mm either way. It was not changed.`,
    wrapped: (name: string, typed: string, shown: string) => `${name} ${typed}° is the same orientation as ${shown}.`,
    noNumber: (name: string) => `${name} must be a number. It was not changed.`,
    form: "Form of the pose",
    forms: {
      json: "JSON",
      matrix: "Matrix",
      quaternion: "Quaternion",
      euler: "Euler angles",
      numpy: "NumPy",
      ros: "ROS",
    },
    formUnits: {
      json: "As the API takes it, mm",
      matrix: "Probe to scene, row by row, mm",
      quaternion: "x y z in mm, then w x y z",
      euler: "x y z in mm, then tilt, rock and rotation in degrees, against the scene's axes",
      numpy: "Probe to scene, mm",
      ros: "geometry_msgs/Pose, metres",
    },
    textLabel: (form: string) => `Pose as ${form}, Enter applies`,
    copy: (form: string) => `Copy the pose as ${form}`,
    copied: "Copied",
    noCopy: "This browser does not let the page copy. The text is selected: press Ctrl+C.",
    gamepad: (name: string) => `Gamepad: ${name}`,
    steering: "Steering by keyboard and gamepad",
    slide: "Slide",
    turn: "Turn",
    finely: "Finely",
    pad: "Gamepad",
    slides: { lateral: "lateral", elevation: "elevation", axial: "axial" },
    turnKeys: "the same with {Shift}: rotate, tilt, rock",
    fineKeys: "with {Alt}",
    padKeys: "left stick and triggers slide, right stick and shoulder buttons turn",
  },
  poseError,
  path: {
    title: "Path of the probe",
    playback: "Playback",
    play: "Play the sweep",
    pause: "Pause the sweep",
    inSweep: "Place in the training sweep",
    inPath: (name: string) => `Place in ${name}`,
    noSweep: "no training sweep",
    viewOf: (place: number, count: number) => `view ${place} of ${count}`,
    poseOf: (place: number, count: number) => `pose ${place} of ${count}`,
    besideViews: "beside the views",
    besidePoses: "beside the poses",
    backToSweep: "Back to the training sweep",
    load: "Load poses",
    loadMeans: "JSON, NumPy (.npy), CSV, TUM, or the header of a PLUS sequence (.igs.mha)",
    file: "File of poses",
    tooLarge: "It is larger than 64 MiB.",
    wrong: (file: string, problem: string) => `${file}: ${problem}`,
    readAs: { mm: "read as millimetres", m: "read as metres" },
    unitGuessed: "the file does not say its unit",
    unit: "Unit of the file",
    units: { mm: "mm", m: "m" },
    transform: "Transform",
    skipped: (count: number) => `${count} ${count === 1 ? "frame was" : "frames were"} not tracked and left out`,
    record: "Record",
    stop: "Stop recording",
    recording: (seconds: string, count: number) => `${seconds} s, ${count} poses`,
    full: "The recording has reached its limit of 100,000 poses and was stopped.",
    recorded: (number: number) => `recording ${number}`,
    none: "Record what the probe does, or load poses. They can then be played, saved and rendered as a data set.",
    summary: (count: number, seconds: string | null, mm: string) =>
      `${count} poses, ${mm} mm long${seconds === null ? "" : `, ${seconds} s`}`,
    save: "Save poses",
    render: "Render as a data set",
    renderMeans: "Every pose becomes a frame, with the image settings of now, in the background",
    format: "Format of the data set",
    progress: (done: number, all: number) => `${done} of ${all} frames`,
    states: { queued: "Waits for its turn", running: "Rendering", succeeded: "Done", failed: "Failed", cancelled: "Cancelled" } as Named,
    cancel: "Cancel",
    download: (name: string) => `Download ${name}`,
    may: (who: string) => `Only ${who} may start jobs.`,
  },
  connection: {
    title: "Connect",
    language: "Language of the example",
    languages: {
      curl: "curl",
      python: "Python",
      grpc: "gRPC",
      websocket: "WebSocket",
      igtl: "OpenIGTLink",
      ros: "ROS 2",
    },
    needs: {
      curl: "Saves one frame as frame.png.",
      python: "Needs the package ultragray-client.",
      grpc: "Needs grpcurl. The service describes its own messages.",
      websocket: "Needs the packages websockets and numpy. For live images from a moving probe.",
      igtl: "Needs the package pyigtl. A device named after the scene gets its images back.",
      ros: "Needs ROS 2 and the package ultragray-ros. Poses come in on /ultragray/probe_pose, in metres, images go out on /ultragray/bmode.",
    },
    intro: "How a program asks for this image:",
    copy: (language: string) => `Copy the example in ${language}`,
    copied: "Copied",
    copyShort: "Copy",
    selected: "This browser does not let the page copy. The text is selected: press Ctrl+C.",
    off: "This service has no OpenIGTLink port. Whoever runs it can open one.",
    registered: (name: string) => `The pose is flange to base; the service leads it into the scene by ${name}.`,
    notRegistered: "The pose is that of the probe in the scene; a connection of OpenIGTLink names a registration by the parameter Registration.",
    localOnly: "OpenIGTLink answers only programs on the service's own machine.",
    ports: "Where a proxy stands in front of the service, its gRPC port may be another one.",
    key: "Put your API key in the place of YOUR_KEY.",
    unknown: "The service does not tell its ports.",
    streams: "Open streams",
    noStreams: "No other program has a stream open on this scene.",
    streamsHere: "Of the service that answers this page; behind a proxy there may be others.",
    follow: "Follow",
    followOf: (name: string) => `Follow ${name}`,
    unfollow: "Stop following",
    following: (name: string) => `Following ${name}`,
    followed: "The image, the probe and the pose are those that this program asks for. Moving the probe yourself ends it.",
    renderedHere: "This program's frames are not pixels that a page can show: the same poses are rendered here.",
    elsewhere: (scene: string) => `It now asks for another scene: ${scene}.`,
    ended: (name: string) => `${name} has closed its stream.`,
    lost: "The connection to the stream is lost. Trying again.",
    steered: (name: string) => `You moved the probe: no longer following ${name}.`,
    unnamed: "A program",
    page: "Another page of the console",
    door: { websocket: "WebSocket", grpc: "gRPC", openigtlink: "OpenIGTLink" },
    rate: (poses: string, frames: string) => `${poses} poses/s, ${frames} frames/s`,
    idle: (time: string) => `quiet for ${time}`,
    age: (time: string) => `open for ${time}`,
    dropped: (count: number) => `${count} replaced by newer ones`,
    readout: "Latency on the image",
    readoutMeans: "Times, age and losses of frames, in the corner of the image",
    latency: (p50: string, p99: string) => `latency ${p50} ms, 99 % below ${p99} ms`,
    asSeen: (queue: string, render: string) => `waited ${queue} ms, rendered in ${render} ms`,
    frameAge: (time: string) => `age of the image ${time}`,
    losses: (count: number) => `${count} poses replaced by newer ones`,
    version: "Version",
    renderer: "Renderer",
    docs: "API documentation",
    waiting: "…",
  },
};

export const locate = {
  title: "Where was this frame taken?",
  label: "Where a real frame was taken",
  choose: "Choose a frame",
  chooseHint: "PNG as the scanner stores it: a column a scan line, not scan-converted",
  size: (width: number, height: number): string => `${width} × ${height} pixels; choose another one here`,
  notPng: (name: string): string => `${name} is not a PNG file.`,
  damaged: (name: string): string => `${name} is damaged: it cannot be shown as a picture.`,
  scanConverted:
    "This looks like a picture of the screen: a fan on black ground. It will hardly be found. Needed is the frame before scan conversion, rows along the depth, a column for each scan line.",
  within: { within_mm: "Off by", within_deg: "Turned by" },
  withinMeans: {
    within_mm: "How far the probe may be off, mm",
    within_deg: "By which angle the probe may be turned",
  },
  search: "Search",
  searchMeans: "Look for the frame about where the probe is now",
  fromHere: "from the present pose",
  searching: "Searching …",
  rendering: "Rendering what is there …",
  stop: "Stop",
  found: "Found.",
  notFound:
    "Not found. Move the probe nearer to where the frame was taken, allow it to be further off, or check that frame, probe and scene belong together.",
  similarity: "Similarity",
  similarityMeans: "Correlation of the structures of the frame and of the scene there, -1 to 1; the right place has more than half",
  positionStd: "Position ±",
  positionStdMeans: "Standard deviations along the probe's lateral, elevation and axial axis",
  angleStd: "Angles ±",
  angleStdMeans: "Standard deviations about the lateral, elevation and axial axis",
  fromStart: "From the start",
  took: "Search took",
  seconds: (amount: string): string => `${amount} s`,
  take: "Go there",
  takeMeans: "Takes the pose that was found as that of the probe",
  frozen: "The image is frozen. Unfreeze it first (F).",
  pictures: "How both pictures are shown",
  side: "Side by side",
  blend: "Blend",
  given: "Given",
  rendered: "Rendered",
  shareOfRendered: "Share of the rendered picture",
};

export const registrations = {
  title: "Registrations",
  none: "None is stored. A registration says how the poses of a robot or a tracker lead into a scene: ultragray calibrate finds one.",
  meaning: "Poses are shown and typed",
  inScene: "of the probe, in the scene",
  into: (scene: string): string => `into ${scene}`,
  residual: (amounts: string): string => `residual ${amounts}`,
  residualMeans: "Root mean square of what was left when it was found",
  noResidual: "residual not told",
  references: (name: string): Record<Reference, string> => ({
    absolute: `Absolute, as ${name} tells it`,
    relativeScene: `Relative, along the axes of ${name}`,
    relativeProbe: "Relative, along the flange's axes",
  }),
  position: (name: string): string => `Position of the flange, as ${name} tells it`,
  angles: (name: string): string => `Angles against the axes of ${name}`,
  about: (axis: string): string => `About ${axis}`,
  form: (name: string): string => `Flange to base, as ${name} tells it`,
  gone: (name: string, scene: string | null): string =>
    `${name} ${scene === null ? "is not stored any more" : `is of the scene ${scene} now`}: poses are those of the probe again.`,
  tag: (name: string): string => `by ${name}`,
  tagMeans: "Poses are told by this registration; chosen below, among the registrations",
};
