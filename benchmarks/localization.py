"""Held-out frames found again in trained scenes, from poses that are 3 mm and 5° off: `make localization`.

Of the built-in phantom the demo scene is used, and the held-out sweep is simulated; the other sets are trained by
`fast` first, without their held-out frames. Each frame is moved in a direction, and turned about an axis, at random.
"""

from __future__ import annotations

import math
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from measuring import Document, Lines, columns, measure_runs
from ultragray.datasets.source import load_dataset
from ultragray.geometry.probe import FloatArray
from ultragray.learn.localization.search import Motions, localize
from ultragray.learn.training import TrainingConfig
from ultragray.phantom import PHANTOM_IMAGE_SIDE, PHANTOM_PROBE, freehand_poses, simulate
from ultragray.phantom.demo import load_demo_scene
from ultragray.scene.gaussians import GaussianScene
from ultragray_studies.report import train_and_evaluate

PHANTOM = "phantom"
SETS = (PHANTOM, "ultranerf_liver", "spine_phantom", "liver_convex")
OFF_MM, OFF_DEG = 3.0, 5.0
FOUND_MM, FOUND_DEG = 0.5, 1.0
SAME_MM = 0.3  # that two searches for a frame may end apart
MOST_FRAMES = 24  # of a set, evenly taken
THREADS = 2


def measure(name: str, data_folder: Path) -> Document:
    """What became of the held-out frames of a set."""
    return row(*held_out(name, data_folder))


def held_out(name: str, data_folder: Path) -> tuple[GaussianScene, Any, FloatArray]:
    """A scene, and frames [N, H, W] that it was not trained from with their poses [N, 4, 4]."""
    if name == PHANTOM:
        poses = freehand_poses(MOST_FRAMES, tilt_deg=5.0, offset_mm=1.0, unrest=3.0)
        images = simulate(poses, probe=PHANTOM_PROBE, height=PHANTOM_IMAGE_SIDE, width=PHANTOM_IMAGE_SIDE)
        return load_demo_scene(), images, poses
    dataset = load_dataset(data_folder / name)
    scene = train_and_evaluate(dataset, TrainingConfig.preset("fast", confidence=False)).scene
    chosen = np.unique(np.linspace(0, len(dataset.val) - 1, MOST_FRAMES).round().astype(int))
    return scene, dataset.val.images[chosen], dataset.val.poses[chosen]


def row(scene: GaussianScene, images: Any, poses: FloatArray) -> Document:
    """What became of the frames: errors and time of each, from a pose that is off and from the recorded one."""
    motions, random = Motions.of(scene.info.probe_or(None)), np.random.default_rng(0)
    errors, at_recorded, apart_mm, took_s, is_found = [], [], [], [], []
    for image, pose in zip(images, poses, strict=True):
        start = displaced(pose, motions, random)
        began = time.perf_counter()
        found = localize(scene, image, start)
        took_s.append(time.perf_counter() - began)
        recorded = localize(scene, image, pose)
        errors.append(between(motions, found.pose, pose))
        at_recorded.append(between(motions, recorded.pose, pose))
        apart_mm.append(between(motions, found.pose, recorded.pose)[0])
        is_found.append(found.is_found)
    within = [shift_mm < FOUND_MM and turn_deg < FOUND_DEG for shift_mm, turn_deg in errors]
    shifts_mm, turns_deg = np.transpose(errors)
    return {
        "frames": len(errors),
        "within": float(np.mean(within)),
        "within_from_recorded": float(np.mean([mm < FOUND_MM and deg < FOUND_DEG for mm, deg in at_recorded])),
        "same_place": float(np.mean([one < SAME_MM for one in apart_mm])),
        "is_found": float(np.mean(is_found)),
        "median_mm": float(np.median(shifts_mm)),
        "median_deg": float(np.median(turns_deg)),
        "p50_s": float(np.median(took_s)),
        "p90_s": float(np.percentile(took_s, 90)),
    }


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
    return columns(
        ({"name": name, **figures[name]} for name in SETS if name in figures),
        {
            "set": "{name}",
            "held-out frames": "{frames}",
            f"within {FOUND_MM:g} mm and {FOUND_DEG:g}°": "{within:.0%}",
            "from the recorded pose": "{within_from_recorded:.0%}",
            "both end in one place": "{same_place:.0%}",
            "median error": "{median_mm:.2f} mm, {median_deg:.2f}°",
            "time, median and 90 of 100": "{p50_s:.2f} s, {p90_s:.2f} s",
        },
    )


if __name__ == "__main__":
    measure_runs("localization", __doc__, {name: partial(measure, name) for name in SETS}, threads=THREADS)
