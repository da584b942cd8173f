/** The English catalogue, which has every text of the console: those of english.json; here the sentences that are given something, and tables that may lack a name. */

import type { Me } from "../../api/service";
import type { Reference } from "../../geometry/pose";
import { type FaultWords, POSE_SUFFIXES } from "../../geometry/pose_files";
import { type Named, translated } from "../translated";
import texts from "./english.json";

const poseError: FaultWords = {
  line: (line, fault) => `Line ${line}: ${fault}`,
  pose: (pose, fault) => `Pose ${pose}: ${fault}`,
  faults: {
    json: (problem) =>
      `This is not JSON that the console knows: a pose is an object of position_mm and quaternion, or of matrix (${problem}).`,
    jsonNumbers: (key, names) => `${key} needs the numbers ${names}.`,
    empty: () => "There are no poses in it.",
    tooMany: (count, most) => `There may be at most ${most} poses, and these are ${count}.`,
    suffix: (suffix) =>
      `Files of this kind (${suffix || "without an ending"}) are not read. Read are: ${POSE_SUFFIXES.join(", ")}.`,
    count: (found, expected) => `${found} numbers were found; ${expected.replace(", ", " or ")} were expected.`,
    number: (text) => `“${text}” is not a number.`,
    quaternion: (length) => `The quaternion must have length 1; this one has ${length.toFixed(3)}.`,
    rotation: () => "The matrix must hold a rotation: axes of length 1 at right angles.",
    mirror: () => "The matrix must hold a rotation; this one mirrors.",
    lastRow: () => "The matrix must end in the row 0 0 0 1; the translation is its last column.",
    ros: (missing) => `A pose of ROS has a position and an orientation; ${missing} was not found.`,
    npyMagic: () => "This is not a file that NumPy wrote.",
    npyShort: () => "The file ends before its last pose.",
    npyType: (type) => `The numbers are of NumPy's type ${type}; float32 or float64 was expected.`,
    npyShape: (shape) => `The array has the shape ${shape}; (N, 4, 4) was expected, also (N, 3, 4), (N, 12) or (N, 16).`,
    csvHeader: (missing) => `The columns ${missing} are missing.`,
    plusHeader: () =>
      "There are no transforms of frames in it (lines such as Seq_Frame0000_ProbeToReferenceTransform).",
    plusTransforms: (found) =>
      `None of its transforms can be a pose of a probe: ${found} hold the size of pixels, or were never tracked.`,
  },
};

const sentences = {
  scan: {
    group: (name: string): string => `${name}: show or hide`,
    image: {
      of: (scene: string): string => `B-mode image of ${scene}`,
      live: (perSecond: number): string => (perSecond < 1 ? "Live" : `Live, ${perSecond.toFixed(0)} frames/s`),
    },
    marks: {
      annotation: (text: string): string => `Text ${text}: move with the arrow keys, Enter changes it, Delete removes it`,
      handle: (letter: string, kind: string, point: number): string =>
        `${letter}, ${kind}, point ${point}: move with the arrow keys, with Shift faster, Delete removes it`,
    },
    results: {
      ellipse: (axes: string, circumference: string, area: string): string => `${axes}, circumference ${circumference}, area ${area}`,
      frame: (number: number): string => `on frame ${number}`,
      remove: (letter: string): string => `Remove ${letter}`,
    },
    store: {
      loopAsVideo: (type: string): string => `Cine loop, video (${type})`,
      recording: (done: number, all: number): string => `Recording the video: frame ${done} of ${all}`,
      drawn: (tools: string): string => `Drawn in: ${tools}`,
      slice: (mm: string): string => `slice ${mm} mm`,
    },
    keys: {
      names: { escape: "Esc", " ": "Space", ctrl: "Ctrl", shift: "Shift", plus: "+", "-": "−" } as Named,
    },
    tgc: {
      slider: (index: number, count: number): string => `Time-gain compensation ${index} of ${count}, dB`,
    },
    display: {
      trained: (mm: string): string => `As trained: ${mm} mm.`,
      contacts: { air: "Dark", pressure: "Dark; pressed tissue gives way" } as Named,
      fields: { dynamic_range_db: "Dynamic range", edge: "Sharpness", tgc_db: "Time-gain compensation" } as Named,
    },
  },
  session: {
    link: {
      refused: (values: readonly string[]): string =>
        `The address holds ${values.length === 1 ? "a value" : "values"} that cannot be used, and the view opened without: ${values.join(", ")}.`,
      count: (count: number): string => `${count} numbers`,
      within: (low: number, high: number): string => `${low} to ${high}`,
      oneOf: (choices: readonly string[]): string => `one of ${choices.join(", ")}`,
    },
    notice: {
      missing: (scene: string): string => `There is no scene ${scene} here.`,
      thereAre: (count: number): string => (count === 1 ? "There is" : "There are"),
      unreadable: (detail: string): string => `This scene file cannot be read: ${detail}`,
    },
    local: {
      tooLarge: (mb: string, most: string): string => `The scene file has ${mb} MB. A page renders scenes of at most ${most} MB.`,
      fetching: (mb: string): string => `The scene file, ${mb} MB, is being fetched …`,
      here: (mb: string): string => `The page has the scene file, ${mb} MB, and renders the image itself.`,
      difference: (largest: number, mean: string): string =>
        largest === 0
          ? "Its frame is the service's, pixel by pixel."
          : `Its frame and the service's differ by at most ${largest} of 255 grey levels, by ${mean} on average.`,
    },
  },
  space: {
    pressed: (mm: string): string => `pressed ${mm} mm`,
  },
  tools: {
    addOne: (kind: string): string => `Add a ${kind.toLowerCase()}`,
    one: (place: number, kind: string): string => `${place} ${kind}`,
    full: (most: number): string => `An image takes at most ${most} tools.`,
    placeOf: (what: string, axis: string): string => `${what} ${axis}`,
    advance: (by_mm: number): string => (by_mm > 0 ? `Advance by ${by_mm} mm` : `Withdraw by ${-by_mm} mm`),
    seen: (what: string, beside_mm: string, depth_mm: string): string => `${what}: ${beside_mm} mm beside the image, ${depth_mm} mm deep`,
    inPlane: (what: string, depth_mm: string): string => `${what}: in the image, ${depth_mm} mm deep`,
  },
  shell: {
    login: {
      at: (place: string): string => `Sign in at ${place}`,
      failed: (why: string): string => `Signing in failed: ${why}`,
    },
    uploading: (name: string): string => `Upload of ${name}`,
    stopUpload: (name: string): string => `Stop the upload of ${name}`,
    key: {
      allowed: (who: readonly Me["role"][], owner: string | null): string =>
        [...(owner === null ? [] : [owner]), ...who.map((role) => `${role}s`)].join(" and "),
    },
  },
  shared: {
    chart: (title: string, unit: string, x: string, series: string[]): string =>
      `${title}${unit && ` in ${unit}`} over ${x}: ${series.join(", ")}`,
    nameValue: (line: string): string => `"${line}" must be written as name = value.`,
    better: (higher: boolean): string => (higher ? "higher is better" : "lower is better"),
    slider: {
      outside: (least: number, most: number, unit: string): string => `This takes ${limits(least, most, unit)}.`,
      reset: (value: number, unit: string): string => `Double click: ${value}${unit && ` ${unit}`}`,
    },
    field: {
      ofList: (label: string, place: number, count: number): string => `${label} ${place} of ${count}`,
      labels: {
        below_min_confidence: "Below that",
        contact: "Off the skin",
        dtype: "Numbers as",
        height: "Depth samples",
        min_confidence: "Least confidence",
        reverberation: "Comet tail",
        shard_frames: "Frames in a file",
        width: "Scan lines",
      } as Named,
    },
    only: (who: string, what: string): string => `Only ${who} may ${what}.`,
    privateTo: (owner: string | null): string => `Only ${owner === null ? "" : `${owner} and `}admins see it`,
  },
  maps: {
    outputs: {
      bmode: { title: "B-mode", meaning: "What a scanner shows: the echo times what is left of the beam." },
      echo: { title: "Echo", meaning: "How strongly the tissue reflects, before the way there takes its share." },
      transmittance: { title: "Transmittance", meaning: "The share of the beam that is left at that depth." },
      coverage: { title: "Coverage", meaning: "How well what was learned supports the pixel; below 0.3 it is mostly a guess." },
      attenuation: { title: "Attenuation", meaning: "The share of the beam that arrives at the pixel and ends there." },
      labels: { title: "Labels", meaning: "The tissue that weighs most in the pixel, or the tool that is there." },
      uncertainty: { title: "Uncertainty", meaning: "The error that the brightness of the pixel is expected to have." },
    } as Readonly<Record<string, { title: string; meaning: string } | undefined>>,
    enlarge: (title: string): string => `${title}, show large`,
    canvas: (title: string): string => `${title} map`,
    legend: (end: number): string => `Scale from 0 to ${end}, from dark to light`,
    label: (number: number): string => `label ${number}`,
  },
  compare: {
    running: (dataset: string): string => `The held-out frames of ${dataset} are predicted and measured. The first one is shown as soon as it is there.`,
    working: (what: string, frame: number, frames: number): string => `${what}: frame ${frame} of ${frames}`,
    scene: (name: string): string => `Scene ${name}`,
    pictureOf: (title: string, frame: number): string => `${title} of frame ${frame}`,
    flicker: { shown: (title: string): string => `Shown: ${title}` },
    cursor: (truth: number, other: number): string => `truth ${truth}, other ${other} of 255`,
    frameNumber: (number: number): string => `Frame ${number}`,
    place: (place: number, count: number, dataset: string): string => `${place} of ${count} held out, ${dataset}`,
    chart: { hint: (better: string): string => `${better}; a click goes to the frame` },
    confidence: {
      r: (value: string): string => `correlation ${value}`,
      point: (frame: number): string => `Frame ${frame}`,
    },
  },
  connect: {
    confidence: {
      similarityMeans: (good: number, warn: number) =>
        `How similar a real image is expected to be to this one (MS-SSIM): from ${good} % on well supported, below ${warn} % a guess`,
      errorMeans: (views: number) => `How far the figure was off, on average, on ${views} views that it was tested on`,
      points: (value: number) => `${value} percentage points`,
      contact: (percent: number) => `contact ${percent} %`,
      expected: (percent: number) => `expected similarity ${percent} %`,
      withError: (percent: number, points: number) => `expected similarity ${percent} %, mean error ${points} percentage points`,
      away: (mm: string, degrees: string) => `${mm} mm and ${degrees}° from the training views`,
      strip: (least: number, place: number) => `Confidence along the poses: lowest ${least} % at ${place}`,
    },
    pose: {
      positionOf: (axis: string) => `Position ${axis}`,
      relativePosition: (other: string) => `Way from ${other}`,
      relativeAngles: (other: string) => `Turn against ${other}`,
      beyond: (name: string, value: string, low: number, high: number) =>
        `${name} ${value} mm lies outside of the scene (${low} to ${high} mm). There is nothing to see there.`,
      tooFar: (name: string, most: number) => `${name} may be at most ${most} mm either way. It was not changed.`,
      wrapped: (name: string, typed: string, shown: string) => `${name} ${typed}° is the same orientation as ${shown}.`,
      noNumber: (name: string) => `${name} must be a number. It was not changed.`,
      textLabel: (form: string) => `Pose as ${form}, Enter applies`,
      copy: (form: string) => `Copy the pose as ${form}`,
      gamepad: (name: string) => `Gamepad: ${name}`,
    },
    poseError,
    path: {
      inPath: (name: string) => `Place in ${name}`,
      viewOf: (place: number, count: number) => `view ${place} of ${count}`,
      poseOf: (place: number, count: number) => `pose ${place} of ${count}`,
      wrong: (file: string, problem: string) => `${file}: ${problem}`,
      skipped: (count: number) => `${count} ${count === 1 ? "frame was" : "frames were"} not tracked and left out`,
      recording: (seconds: string, count: number) => `${seconds} s, ${count} poses`,
      recorded: (number: number) => `recording ${number}`,
      summary: (count: number, seconds: string | null, mm: string) =>
        `${count} poses, ${mm} mm long${seconds === null ? "" : `, ${seconds} s`}`,
      keyframesOf: (count: number) => (count === 1 ? "1 keyframe" : `${count} keyframes`),
      filming: (done: number, all: number) => `Rendering: ${done} of ${all}`,
    },
    connection: {
      copy: (language: string) => `Copy the example in ${language}`,
      registered: (name: string) => `The pose is flange to base; the service leads it into the scene by ${name}.`,
      followOf: (name: string) => `Follow ${name}`,
      following: (name: string) => `Following ${name}`,
      elsewhere: (scene: string) => `It now asks for another scene: ${scene}.`,
      ended: (name: string) => `${name} has closed its stream.`,
      steered: (name: string) => `You moved the probe: no longer following ${name}.`,
      rate: (poses: string, frames: string) => `${poses} poses/s, ${frames} frames/s`,
      idle: (time: string) => `quiet for ${time}`,
      age: (time: string) => `open for ${time}`,
      dropped: (count: number) => `${count} replaced by newer ones`,
      latency: (p50: string, p99: string) => `latency ${p50} ms, 99 % below ${p99} ms`,
      asSeen: (queue: string, render: string) => `waited ${queue} ms, rendered in ${render} ms`,
      frameAge: (time: string) => `age of the image ${time}`,
      losses: (count: number) => `${count} poses replaced by newer ones`,
    },
  },
  labels: {
    another: (label: number): string => `Tissue ${label}`,
    choose: (name: string): string => `Paint with ${name}`,
    nameOf: (label: number): string => `Name of label ${label}`,
    state: (frames: number, made: string | null): string => {
      if (made === null) return "Nothing is saved yet.";
      return `${frames === 1 ? "One frame" : `${frames} frames`} painted, saved as ${made}.`;
    },
    open: (scene: string): string => `Open ${scene}`,
  },
  edit: {
    gone: (scene: string): string => `${scene} (not here any more)`,
    without: (what: string): string => `without ${what}`,
    remove: (number: number): string => `Remove edit ${number}`,
    painted: (count: number): string => (count === 1 ? "1 shape" : `${count} shapes`),
  },
  plan: {
    found: (count: number, before: string, after: string, path_mm: string): string =>
      `${count} views, ${before} → ${after}, ${path_mm} mm of way`,
    view: (number: number, gain: string, rank: number): string => `${number}: +${gain} (gain number ${rank})`,
  },
  locate: {
    size: (width: number, height: number): string => `${width} × ${height} pixels; choose another one here`,
    notPng: (name: string): string => `${name} is not a PNG file.`,
    damaged: (name: string): string => `${name} is damaged: it cannot be shown as a picture.`,
    seconds: (amount: string): string => `${amount} s`,
  },
  registrations: {
    into: (scene: string): string => `into ${scene}`,
    residual: (amounts: string): string => `residual ${amounts}`,
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
  },
  train: {
    frames: (count: number, isPrivate: boolean): string => `${count} frames${isPrivate ? ", private" : ""}`,
    upload: {
      files: (count: number): string => `${count} files`,
      sending: (percent: number): string => `Sending, ${percent} %`,
    },
    crop: {
      size: (width: number, height: number, of: string): string => `${width} × ${height} of ${of} pixels`,
      outside: (width: number, height: number): string => `The crop must lie within columns 0 to ${width} and rows 0 to ${height}.`,
      alt: (frame: number): string => `Frame ${frame} as it is stored`,
    },
    dataset: {
      label: (name: string): string => `Dataset ${name}`,
      warnings: (count: number): string => (count === 1 ? "1 warning" : `${count} warnings`),
      onlyMay: (who: string): string => `Only ${who} may delete it`,
      split: (train: number, val: number): string => `${train} to train from, ${val} held out`,
      pixels: (width: number, height: number, bytes: string): string => `${width} × ${height} pixels, ${bytes}`,
      spacingOf: (lateral: string, axial: string): string => `${lateral} mm across, ${axial} mm in depth`,
      regionOf: (left: number, right: number, top: number, bottom: number, size: string): string =>
        `columns ${left} to ${right}, rows ${top} to ${bottom} of ${size}`,
      calibrationOf: (column: string, row: string, across: string, deep: string): string =>
        `Columns of the image run along the probe's ${column}, rows along its ${row}; its first pixel lies ${across} mm across and ${deep} mm deep from the probe's marker frame.`,
      skewed: (degrees: string): string => `Columns and rows meet at ${degrees}°.`,
      frameAlt: (index: number, name: string): string => `Frame ${index} of ${name}`,
      sheetAlt: (index: number): string => `Frame ${index}`,
    },
    start: {
      presets: {
        fast: "Minutes on two cores.",
        best: "As fast, with the effort that frames left out ask for: half an hour.",
        paper: "The published recipe: hours.",
      } as Named,
      settingsChanged: (count: number): string => `All settings (${count} changed)`,
      repeats: (scene: string): string => `With the settings of ${scene}: what you change is marked.`,
    },
    settings: {
      before: (value: string): string => `was ${value}`,
      resetOf: (name: string): string => `${name}: back to the default`,
      from: (low: string): string => `from ${low}`,
      above: (low: string): string => `above ${low}`,
      to: (high: string): string => `to ${high}`,
      count: (count: number): string => `${count} settings`,
      least: (low: string): string => `This must be at least ${low}.`,
      aboveProblem: (low: string): string => `This must be above ${low}.`,
      most: (high: string): string => `This must be at most ${high}.`,
    },
    render: {
      samplers: {
        around: "Around the sweep, at random",
        covered: "In the region that the sweep covers",
        fan: "Tilted sweeps",
        spline: "Evenly along the sweep",
        training: "The sweep itself",
      } as Named,
      previewHint: (shown: number, all: string): string => `${shown} of ${all}`,
      thumbnailAlt: (number: number): string => `Rendered example ${number}`,
      confidence: (value: string): string => `confidence ${value}`,
      upTo: (size: string): string => `up to ${size}`,
      inFiles: (count: string): string => `in ${count} files`,
      about: (time: string): string => `about ${time} on one process of this service`,
      frameSize: (height: number, width: number): string => `${height} × ${width} pixels`,
    },
  },
  jobs: {
    rendered: {
      confidence: (least: string, greatest: string, mean: string): string => `Confidence ${least} to ${greatest}, mean ${mean}`,
      frame: (number: number): string => `Frame ${number}`,
    },
    unfinished: (count: number): string => (count === 1 ? "1 under way" : `${count} under way`),
    waitsFor: (what: string): string => `It waits for ${what}.`,
    label: (kind: string, subject: string): string => `Job ${kind} of ${subject}`,
    tryingAgain: (problem: string): string => `${problem} Trying again.`,
    method: (name: string, number: number, of: number): string => `${name}, method ${number} of ${of}`,
    step: (done: string, all: string): string => `Step ${done} of ${all}`,
    frame: (done: string, all: string): string => `Frame ${done} of ${all}`,
    loss: (value: string): string => `Loss ${value}`,
    heldOut: (value: string): string => `${value} dB on some held-out frames`,
    gaussians: (count: string): string => `${count} Gaussians`,
    stepsPerSecond: (rate: string): string => `${rate} steps/s`,
    framesPerSecond: (rate: string): string => `${rate} frames/s`,
    left: (time: string): string => `about ${time} left`,
    classical: {
      linear: "linear between frames", median: "median compounding", mean: "mean compounding", maximum: "maximum compounding",
      nearest: "nearest training frame", "in-time": "neighbours in time",
    } as Named,
    scored: { "": "as given", on_path: "on the path", registered: "registered by halves" } as Named,
    earlierHint: (most: number): string => `Up to ${most} are laid over the curves, dashed.`,
    atStep: (step: string): string => `after step ${step}`,
    renderingAlt: (step: string): string => `Its rendering after step ${step}`,
    heldOutAlt: (frame: string): string => `Held-out frame ${frame}`,
    otherFiles: (count: number): string => `${count} more: curves, pictures and figures`,
    namesValues: (names: string): string => `${names}: one name = value a line`,
  },
  scenes: {
    isThere: (name: string): string => `${name} is there.`,
    gaussians: (count: string): string => `${count} Gaussians`,
    compareOne: (name: string): string => `Compare ${name}`,
    deleteOne: (name: string): string => `Delete ${name}?`,
    deletedBy: (who: string): string => `Only ${who} may delete it`,
    import: {
      hint: (suffix: string): string => `Drop or choose a scene file (${suffix})`,
    },
    service: {
      ofAll: (some: number, all: number): string => `${some} of ${all}`,
      latency: (which: string): string => `Latency, ${which.toLowerCase()}`,
      minutes: (minutes: number): string => `${minutes} min`,
    },
    workers: {
      process: (host: string, pid: number, release: string): string => `Host ${host}, process ${pid}, release ${release}`,
    },
    audit: {
      span: (hours: number): string => (hours === 1 ? "hour" : hours === 24 ? "day" : `${hours / 24} days`),
    },
  },
};

export type Words = typeof texts & typeof sentences;

export const english = translated<object>(texts, sentences) as Words;

/** "from -3 to 5 mm", "at least 1", "a number". */
function limits(least: number, most: number, unit: string): string {
  const mm = unit && ` ${unit}`;
  if (Number.isFinite(least) && Number.isFinite(most)) return `a number from ${least} to ${most}${mm}`;
  if (Number.isFinite(least)) return `a number of at least ${least}${mm}`;
  return Number.isFinite(most) ? `a number of at most ${most}${mm}` : "a number";
}
