"""Trainings without one part each, and along the settings of texture, with three seeds: `make ablations`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from bone_shadow import BoneShadow
from measuring import Document, Lines, measure_runs, table
from ultragray.datasets.source import PHANTOM, SourceOptions, load_dataset
from ultragray.learn.evaluation.scoring import render_sweep
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.config import TEXTURE
from ultragray_studies.report import train_and_evaluate

SEEDS = (0, 1, 2)
SHORTER = {"steps": 400, "max_gaussians": 40_000, "confidence": False}  # than `fast`, so that an hour is enough
TEXTURES = (0.0, 0.05, 0.2, 0.5)
AS_IT_IS = "as it is"
# The settings that each training changes, by its name.
WITHOUT: Mapping[str, Mapping[str, Any]] = {
    AS_IT_IS: {},
    "no views between frames": {"views_between": 0.0},
    "no shift out of the plane": {"out_of_plane_mm": 0.0},
    "no floor in shadows": {"intensity_floor": 0.0},
    "absorption has no price": {"absorption_penalty": 0.0},
    "no absorption": {"transmittance": False},
    "random start": {"start": "random"},
    "poses as tracked": {"refine_poses": "none"},
}
CURVE: Mapping[str, Mapping[str, Any]] = {
    AS_IT_IS if value == TEXTURE else f"texture {value:g}": {} if value == TEXTURE else {"texture": value}
    for value in TEXTURES
}
SOURCES = {
    "ultranerf_liver_other_side": ("ultranerf_liver", SourceOptions("0:90", "90:180")),
    "spine_phantom": ("spine_phantom", SourceOptions()),
    "nwire_phantom": ("nwire_phantom", SourceOptions()),
    "phantom": (PHANTOM, SourceOptions()),
}


@cache
def dataset_of(name: str, data_folder: Path) -> Dataset:
    folder, options = SOURCES[name]
    return load_dataset(folder if folder == PHANTOM else data_folder / folder, options)


def measure(name: str, settings: Mapping[str, Any], seed: int, data_folder: Path) -> Document:
    """One training, and its held-out frames."""
    dataset = dataset_of(name, data_folder)
    config = TrainingConfig.preset("fast", **{**SHORTER, **settings}, seed=seed)
    trained = train_and_evaluate(dataset, config)
    figures = {
        **trained.evaluation.mean.to_dict(),
        **trained.evaluation.speckle.figures(),
        "config": config.to_dict(),
    }
    if dataset.name == PHANTOM:
        shadow = BoneShadow.of(dataset.val)
        figures["shadow_mae"] = shadow.mean_absolute_error(render_sweep(trained.scene, dataset.val))
    return figures


RUNS = {
    f"{name}, {variation}, seed {seed}": partial(measure, name, settings, seed)
    for name in SOURCES
    for variation, settings in {**WITHOUT, **CURVE}.items()
    for seed in SEEDS
}


def trained_without(figures: Document) -> Lines:
    """Trainings without one part each, then the curve of texture."""
    steps, count = SHORTER["steps"], SHORTER["max_gaussians"]
    seeds = len(SEEDS)
    sets = list(dict.fromkeys(name.split(", ")[0] for name in figures))
    yield f"Trainings without one part each, of {steps} steps and {count:,} Gaussians: less than for the figures above."
    yield f"PSNR (dB) and MS-SSIM on held-out frames, mean and standard deviation over {seeds} seeds; then, where"
    yield from ("it is known, the mean absolute error in the shadow of bone.", "")

    def cell(of: str, variation: str, keys: Sequence[str]) -> str:
        runs = [figures.get(f"{of}, {variation}, seed {seed}", {}) for seed in SEEDS]
        shown = []
        for key in keys:
            if values := [run[key] for run in runs if key in run]:
                digits = {"psnr_db": 2, "shadow_mae": 4}.get(key, 3)
                shown.append(f"{np.mean(values):.{digits}f} ± {np.std(values):.{digits}f}")
        return " / ".join(shown) or "–"

    def variations(names: Iterable[str], keys: Sequence[str]) -> Iterator[str]:
        return table(("", *sets), ((name, *(cell(of, name, keys) for of in sets)) for name in names))

    yield from variations(WITHOUT, ("psnr_db", "ms_ssim", "shadow_mae"))
    yield from (
        "",
        "The share of SSIM in the loss (`texture`): PSNR, MS-SSIM and GMSD on held-out frames, and the contrast of",
        "speckle (std/mean of the envelope), rendered and true:",
        "",
    )
    keys = ("psnr_db", "ms_ssim", "gmsd", "speckle_contrast", "true_speckle_contrast")
    yield from variations(CURVE, keys)


if __name__ == "__main__":
    measure_runs("ablations", __doc__, RUNS)
