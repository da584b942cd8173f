"""Trains and measures on tracked and simulated sweeps, beside classical methods: `make results`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bone_shadow import BoneShadow
from figures import Document, measure_runs, teller
from in_silico import IN_SILICO
from ultragray.datasets.source import PHANTOM, SourceOptions, load_dataset
from ultragray.learn.evaluation.baselines import BASELINES, affordable_voxel_mm, evaluate_baselines, predict
from ultragray.learn.evaluation.scoring import render_sweep
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import TrainingConfig
from ultragray.scene.gaussians import GaussianScene
from ultragray_studies.report import train_and_evaluate

THIRD, BAND_SPACINGS = 3, 10


class Part(Enum):
    """The frames of a dataset that a run trains from."""

    WHOLE = "all"
    THIRD = "every third"  # the others are held out
    BAND = "all but a band"  # of ten spacings in the middle of the sweep, which is held out


@dataclass(frozen=True)
class Run:
    """One training. `source` is a folder of the data folder, the word phantom, or a name of IN_SILICO."""

    source: str
    part: Part = Part.WHOLE
    preset: str = "fast"
    options: SourceOptions = field(default_factory=SourceOptions)
    settings: Mapping[str, Any] = field(default_factory=dict)


_LESS = {"steps": 1_000, "initial_gaussians": 30_000, "max_gaussians": 60_000}
RUNS = {
    "ultranerf_liver": Run("ultranerf_liver"),
    "ultranerf_liver_other_side": Run("ultranerf_liver", options=SourceOptions("0:90", "90:180")),
    **{name: Run(name) for name in ("liver_convex", "spine_phantom", "nwire_phantom", PHANTOM)},
    **{name: Run(name) for name in ("robot", "fourth tilt +6°", "fourth tilt +18°")},
    **{
        f"{name}, {part.value}": Run(name, part)
        for name in ("ultranerf_liver", "liver_convex", "spine_phantom", "nwire_phantom")
        for part in (Part.THIRD, Part.BAND)
    },
    **{f"{name}, preset best": Run(name, preset="best") for name in ("nwire_phantom", "spine_phantom")},
    "ultranerf_liver_paper": Run("ultranerf_liver", preset="paper", settings=_LESS),
}


def measure(name: str, data_folder: Path) -> Document:
    """Trains and measures one run, and the baselines on the same frames."""
    run = RUNS[name]
    dataset = part_of(_source(run, data_folder), run.part)
    voxel_mm = affordable_voxel_mm(dataset.train)
    baselines = evaluate_baselines(dataset, BASELINES, voxel_mm)
    config = TrainingConfig.preset(run.preset, **run.settings)
    trained = train_and_evaluate(dataset, config, report=teller(name))
    evaluations = {"scene": trained.evaluation, **baselines}
    figures = {
        "train_frames": len(dataset.train),
        "val_frames": len(dataset.val),
        "image": f"{dataset.train.height}x{dataset.train.width}",
        "split": {"train": run.options.train_frames, "val": run.options.val_frames},
        "ms_ssim_scales": trained.evaluation.ms_ssim_scales,
        "voxel_mm": voxel_mm,
        "metrics": {
            method: {"mean": evaluation.mean.to_dict(), "std": evaluation.std.to_dict()}
            for method, evaluation in evaluations.items()
        },
        "preset": run.preset,
        "settings": dict(run.settings),
        "steps": trained.scene.info.training["steps"],
        "gaussians": trained.scene.gaussian_count,
        "step_ms": 1000.0 * trained.course.step_s,
        "total_s": trained.course.seconds,
    }
    if run.source == PHANTOM:
        figures["shadow"] = measure_shadow(trained.scene, dataset, voxel_mm)
    return figures


def _source(run: Run, data_folder: Path) -> Dataset:
    if run.source in IN_SILICO:
        asked = IN_SILICO[run.source]()
        return Dataset(run.source, train=asked.training, val=asked.unseen)
    return load_dataset(run.source if run.source == PHANTOM else data_folder / run.source, run.options)


def part_of(dataset: Dataset, part: Part) -> Dataset:
    """The dataset with the part of its training frames to train from, and what that leaves out held out."""
    if part is Part.WHOLE:
        return dataset
    sweep, places = dataset.train, np.arange(len(dataset.train))
    left_out = {Part.THIRD: places % THIRD != 0, Part.BAND: np.abs(places - len(sweep) // 2) < BAND_SPACINGS / 2}[part]
    return Dataset(dataset.name, train=sweep.select(places[~left_out]), val=sweep.select(places[left_out]))


def measure_shadow(scene: GaussianScene, dataset: Dataset, voxel_mm: float) -> dict[str, float]:
    """The scene and median compounding on the phantom's held-out frames where bone hides everything."""
    shadow = BoneShadow.of(dataset.val)
    compounded = predict(dataset.train, dataset.val.poses, "median", voxel_mm=voxel_mm)
    return {
        "scene_mae": shadow.mean_absolute_error(render_sweep(scene, dataset.val)),
        "median_mae": shadow.mean_absolute_error(compounded),
        "scene_transmittance": shadow.mean(render_sweep(scene, dataset.val, output="transmittance")),
    }


if __name__ == "__main__":
    measure_runs("results_tables", __doc__, {name: partial(measure, name) for name in RUNS})
