"""Trainings without one part each, and along the settings of texture, with three seeds: `make ablations`.

The path of a hand's frames (`training.agreement`) has no settings for its parts; what decides on each is patched.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from bone_shadow import BoneShadow
from hand import ALL, SWEEPS
from measuring import Document, Lines, measure_runs, table
from ultragray.datasets.source import PHANTOM, SourceOptions, load_dataset
from ultragray.learn.evaluation.held_out import score_held_out
from ultragray.learn.evaluation.scoring import render_sweep
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import TrainingConfig, agreement
from ultragray.learn.training.config import TEXTURE
from ultragray_studies.hand import HandSweep
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
}
CURVE: Mapping[str, Mapping[str, Any]] = {
    AS_IT_IS if value == TEXTURE else f"texture {value:g}": {} if value == TEXTURE else {"texture": value}
    for value in TEXTURES
}
HANDS = {"one pass of a hand": "one pass", "two passes of a hand": "two that cross"}
# The settings, and what stands in the place of names of `agreement`, by the name of a training on the sweep of a hand.
OF_PATH: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]] = {
    AS_IT_IS: ({}, {}),
    "the tracker's noise stays": ({}, {"without_noise": lambda poses, ranges: poses}),
    "no delay": ({}, {"GAIN_OF_DELAY_DB": math.inf}),
    "no calibration": ({}, {"found_calibration": lambda sweep, ranges: np.eye(4)}),
    "tissue is rigid": ({}, {"GAIN_OF_SHARES_DB": math.inf}),
    "steps are not evened": ({}, {"GAIN_OF_EVENNESS_DB": math.inf}),
    "passes need not agree": ({}, {"LOSS_OF_CROSSING_DB": -math.inf}),
    "poses as tracked": ({"refine_poses": "none"}, {}),
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


def measure_hand(name: str, variation: str, seed: int, _: Path) -> Document:
    """One training from the sweep of a hand with all its errors; its held-out frames as given and on its path."""
    dataset = HandSweep.of(*SWEEPS[HANDS[name]]).recorded(ALL)
    settings, parts = OF_PATH[variation]
    config = TrainingConfig.preset("fast", **{**SHORTER, **settings}, seed=seed)
    with ExitStack() as patches:
        for part, instead in parts.items():
            patches.enter_context(patch.object(agreement, part, instead))
        trained = train_and_evaluate(dataset, config)
        scores = score_held_out(trained.scene, dataset, trained.evaluation).to_dict()
    means = {kind: one["mean"] for kind, one in scores.items() if one is not None}
    return {**means, "config": config.to_dict()}


RUNS = {
    f"{name}, {variation}, seed {seed}": partial(measure, name, settings, seed)
    for name in SOURCES
    for variation, settings in {**WITHOUT, **CURVE}.items()
    for seed in SEEDS
}
HAND_RUNS = {
    f"{name}, {variation}, seed {seed}": partial(measure_hand, name, variation, seed)
    for name in HANDS
    for variation in OF_PATH
    for seed in SEEDS
}


def of_sets(figures: Document) -> Document:
    """The runs that are not of the sweep of a hand."""
    return {name: run for name, run in figures.items() if name not in HAND_RUNS}


def of_hands(figures: Document) -> Document:
    """Those that are."""
    return {name: run for name, run in figures.items() if name in HAND_RUNS}


def path_without(figures: Document) -> Lines:
    """Trainings on the path of a hand's frames, without one part of it each."""
    names = [name for name in HANDS if any(run.startswith(name) for run in figures)]

    def cell(name: str, variation: str, kind: str) -> str:
        candidates = [figures.get(f"{name}, {variation}, seed {seed}", {}).get(kind) for seed in SEEDS]
        runs = [one for one in candidates if one is not None]
        if not runs:
            return "–"
        pairs = ((key, [run[key] for run in runs], digits) for key, digits in (("psnr_db", 2), ("gmsd", 3)))
        return " / ".join(f"{np.mean(values):.{digits}f} ± {np.std(values):.{digits}f}" for _, values, digits in pairs)

    kinds = {"as given": "as_given", "on the path": "on_path"}
    heads = ("", *(f"{name}, {kind}" for name in names for kind in kinds))
    rows = (
        (variation, *(cell(name, variation, kind) for name in names for kind in kinds.values()))
        for variation in OF_PATH
    )
    yield from table(heads, rows)


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
        texts = []
        for key in keys:
            if values := [run[key] for run in runs if key in run]:
                digits = {"psnr_db": 2, "shadow_mae": 4}.get(key, 3)
                texts.append(f"{np.mean(values):.{digits}f} ± {np.std(values):.{digits}f}")
        return " / ".join(texts) or "–"

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
    measure_runs("ablations", __doc__, {**RUNS, **HAND_RUNS})
