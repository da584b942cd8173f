"""Held-out frames found again in trained scenes, from poses that are 3 mm and 5° off: `make localization`.

Of the built-in phantom the demo scene is used, and the held-out sweep is simulated; the other sets are trained by
`fast` first, without their held-out frames. Each frame is moved in a direction, and turned about an axis, at random.

A tracker that shakes is no judge of what is found: errors are also those against the path that the scene was trained
on, which no held-out image has a part in, and against the true poses where they are known.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from hand import ERRORS, SWEEPS
from measuring import Document, Lines, columns, measure_runs
from ultragray.datasets.source import load_dataset
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import turns_of
from ultragray.learn.localization.appearance import Motions
from ultragray.learn.localization.search import Tracker, localize
from ultragray.learn.localization.settings import Localization, SearchKind
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.poses import held_out_on_path
from ultragray.phantom import PHANTOM_IMAGE_SIDE, PHANTOM_PROBE, freehand_poses, simulate
from ultragray.phantom.demo import load_demo_scene
from ultragray.scene.gaussians import GaussianScene
from ultragray_studies.bench.report import cell
from ultragray_studies.hand import HandSweep
from ultragray_studies.report import train_and_evaluate

PHANTOM, SHAKING = "phantom", "a hand, noise of 0.13 mm and 0.1°"
SETS = (PHANTOM, SHAKING, "ultranerf_liver", "spine_phantom", "liver_convex")
IN_MOTION = f"{PHANTOM} in motion"
OFF_MM, OFF_DEG = 3.0, 5.0
FOUND_MM, FOUND_DEG = 0.5, 1.0
SAME_MM = 0.3  # that two searches for a frame may end apart
MOST_FRAMES = 24  # of a set, evenly taken
THREADS = 1
ERROR = "{scores[within]:.0%}: {scores[median_mm]:.2f} mm, {scores[median_deg]:.2f}°"


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A scene and frames that it was not trained from, with their poses (mm)."""

    scene: GaussianScene
    sweep: Sweep  # as recorded
    on_path: FloatArray | None = None  # [F, 4, 4] in the tissue at rest; None: as recorded
    true: FloatArray | None = None  # [F, 4, 4]; None: unknown


def measure(name: str, data_folder: Path) -> Document:
    """What became of the held-out frames of a set."""
    if name == PHANTOM:
        poses = freehand_poses(MOST_FRAMES, tilt_deg=5.0, offset_mm=1.0, unrest=3.0)
        images = simulate(poses, probe=PHANTOM_PROBE, height=PHANTOM_IMAGE_SIDE, width=PHANTOM_IMAGE_SIDE)
        sweep = Sweep(images, poses, PHANTOM_PROBE, np.arange(MOST_FRAMES), name)
        return row(HeldOut(load_demo_scene(), sweep, true=poses))
    if name == SHAKING:
        truth = HandSweep.of(*SWEEPS["one pass"])
        recorded, exact = (truth.recorded(ERRORS[error]) for error in (SHAKING.removeprefix("a hand, "), "none"))
        return row(trained(recorded, true=exact.val.poses))
    return row(trained(load_dataset(data_folder / name)))


def in_motion(_: Path) -> Document:
    """Frames of the phantom one after another, 0.7 mm and 0.3° apart: each from the one before, and each from nowhere.

    On all cores. The first frame of all makes the index of places, and is told apart.
    """
    torch.set_num_threads(os.cpu_count() or 1)
    poses = freehand_poses(120, tilt_deg=5.0, offset_mm=1.0, unrest=3.0)[40 : 40 + MOST_FRAMES]
    images = simulate(poses, probe=PHANTOM_PROBE, height=PHANTOM_IMAGE_SIDE, width=PHANTOM_IMAGE_SIDE)
    scene, motions = load_demo_scene(), Motions.of(PHANTOM_PROBE)
    tracker = Tracker(scene, poses[0])
    tracker.locate(images[0])  # searched for, as the motion is not known yet
    index_s = timed(lambda: localize(scene, images[0], search=SearchKind.ANYWHERE))[1]
    ways = {
        "tracked": tracker.locate,
        "anywhere": lambda image: localize(scene, image, search=SearchKind.ANYWHERE),
    }
    rows = {}
    for way, locate in ways.items():
        results, wall_s, cpu_s = zip(*(timed(partial(locate, image)) for image in images[1:]), strict=True)
        rows[way] = {
            **scores(motions, np.stack([one.pose for one in results]), poses[1:]),
            "is_found": float(np.mean([one.is_found for one in results])),
            **{f"{name}_ms": 1000.0 * float(np.median(took)) for name, took in (("wall", wall_s), ("cpu", cpu_s))},
        }
    return {"frames": len(poses) - 1, "rows": rows, "index_s": index_s, "load": os.getloadavg()[0]}


def timed(locate: Callable[[], Localization]) -> tuple[Localization, float, float]:
    """What is found, the time that it takes, and the CPU time."""
    began_s = time.perf_counter(), time.process_time()
    result = locate()
    return result, time.perf_counter() - began_s[0], time.process_time() - began_s[1]


def trained(dataset: Dataset, true: FloatArray | None = None) -> HeldOut:  # [V, 4, 4] mm
    scene = train_and_evaluate(dataset, TrainingConfig.preset("fast", confidence=False)).scene
    placed = held_out_on_path(dataset, scene)
    chosen = np.unique(np.linspace(0, len(dataset.val) - 1, MOST_FRAMES).round().astype(int))
    on_path = None if placed is None else placed.poses[chosen]
    return HeldOut(scene, dataset.val.select(chosen), on_path, None if true is None else true[chosen])


def row(held_out: HeldOut) -> Document:
    """What became of the frames: errors by each kind of poses, and CPU time of each search."""
    scene, sweep = held_out.scene, held_out.sweep
    motions, random = Motions.of(sweep.probe), np.random.default_rng(0)
    results, apart_mm, took_s = [], [], []
    for image, pose in zip(sweep.images, sweep.poses, strict=True):
        start = displaced(pose, motions, random)
        began_s = time.process_time()
        results.append(localize(scene, image, start))
        took_s.append(time.process_time() - began_s)
        apart_mm.append(between(motions, results[-1].pose, localize(scene, image, pose).pose)[0])
    poses = np.stack([one.pose for one in results])
    errors = {
        "recorded": (poses, sweep.poses),
        "on_path": (scene.poses_at_rest(poses), held_out.on_path),
        "true": (poses, held_out.true),
    }
    own, right = next(errors[kind] for kind in ("true", "on_path", "recorded") if errors[kind][1] is not None)
    ratios = deviations_of(motions, results, own, right)
    return {
        "frames": len(results),
        **{name: None if right is None else scores(motions, own, right) for name, (own, right) in errors.items()},
        **{f"within_{count}": float(np.mean(ratios < count)) for count in (1, 2)},
        "same_place": float(np.mean([one < SAME_MM for one in apart_mm])),
        "is_found": float(np.mean([one.is_found for one in results])),
        "p50_cpu_s": float(np.median(took_s)),
        "p90_cpu_s": float(np.percentile(took_s, 90)),
    }


def scores(motions: Motions, poses: FloatArray, right: FloatArray) -> Document:  # [F, 4, 4] mm, both
    """The share of poses within FOUND_MM and FOUND_DEG, and the median errors."""
    shifts_mm, turns_deg = np.transpose([between(motions, *pair) for pair in zip(poses, right, strict=True)])
    return {
        "within": float(np.mean((shifts_mm < FOUND_MM) & (turns_deg < FOUND_DEG))),
        "median_mm": float(np.median(shifts_mm)),
        "median_deg": float(np.median(turns_deg)),
    }


def deviations_of(
    motions: Motions, found: Sequence[Localization], poses: FloatArray, right: FloatArray
) -> FloatArray:  # [F, 4, 4] mm, both -> [F, 6]
    """The sizes of the errors of all six numbers, in standard deviations as they are told."""
    left, middle = np.linalg.inv(poses) @ right, motions.middle_mm.numpy()
    errors_mm = left[:, :3, 3] + left[:, :3, :3] @ middle - middle
    errors = np.concatenate([errors_mm, np.degrees(turns_of(left[:, :3, :3]))], axis=1)
    return np.abs(errors) / [one.position_std_mm + one.angle_std_deg for one in found]


def displaced(pose: FloatArray, motions: Motions, random: np.random.Generator) -> FloatArray:  # [4, 4] both
    """A pose whose image has its middle 3 mm away, and is turned by 5°."""
    shift, axis = random.normal(size=3), random.normal(size=3)
    turn_mm = math.radians(OFF_DEG) * motions.lever_mm * axis / np.linalg.norm(axis)
    step = np.concatenate([OFF_MM * shift / np.linalg.norm(shift), turn_mm])
    return np.asarray(motions.moved(torch.from_numpy(pose), torch.from_numpy(step)).numpy())


def between(motions: Motions, one: FloatArray, other: FloatArray) -> tuple[float, float]:  # mm, degrees
    """How far two poses of an image are apart."""
    return motions.step_between(torch.from_numpy(one), torch.from_numpy(other))


def found_frames(figures: Document) -> Lines:
    """Held-out frames that were looked for."""
    rows = []
    for name in SETS:
        if (run := figures.get(name)) is not None:
            kinds = {kind: cell(ERROR, {"scores": run[kind]}) for kind in ("recorded", "on_path", "true")}
            rows.append({"name": name, **run, **kinds})
    return columns(
        rows,
        {
            "set": "{name}",
            "held-out frames": "{frames}",
            "against the recorded poses": "{recorded}",
            "the path": "{on_path}",
            "the true poses": "{true}",
            "errors within 1σ, 2σ": "{within_1:.0%}, {within_2:.0%}",
            "both searches end in one place": "{same_place:.0%}",
            "CPU time, median and 90 of 100": "{p50_cpu_s:.2f} s, {p90_cpu_s:.2f} s",
        },
    )


def of_motion(figures: Document) -> Document:
    """The run that the table of frames in motion is of."""
    return {IN_MOTION: figures[IN_MOTION]}


def frames_in_motion(figures: Document) -> Lines:
    """Frames that were tracked, and those that were looked for anywhere."""
    run = figures[IN_MOTION]
    yield from columns(
        [{"way": way, **run, **row} for way, row in run["rows"].items()],
        {
            "way": "{way}",
            "frames": "{frames}",
            "within 0.5 mm and 1°": "{within:.0%}",
            "median error": "{median_mm:.2f} mm, {median_deg:.2f}°",
            "time of a frame": "{wall_ms:.0f} ms",
            "CPU time": "{cpu_ms:.0f} ms",
        },
    )
    yield from (
        "",
        f"The first search makes the index, once for a scene and a probe: {run['index_s']:.1f} s. The load of the "
        f"machine meanwhile, all programs together: {run['load']:.1f}.",
    )


if __name__ == "__main__":
    runs: dict[str, Callable[[Path], Document]] = {name: partial(measure, name) for name in SETS}
    measure_runs("localization", __doc__, {**runs, IN_MOTION: in_motion}, threads=THREADS)
