"""Trainings without one part each, and along the settings of texture, with three seeds.

    python benchmarks/ablations.py DATA_FOLDER [--only NAME ...]

The figures of a training go into build/bench/ablations.json as soon as it is done; trainings that the file holds from
the same commit are not repeated. The tables of docs/results.md come from it.
"""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from registry import FIGURES, Document
from ultragray.datasets.source import PHANTOM, SourceOptions, load_dataset
from ultragray.files import write_whole
from ultragray.learn.evaluation.scoring import render_sweep
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.config import TEXTURE
from ultragray.phantom.imaging import BoneShadow
from ultragray_studies.bench.report import DIRTY, measured
from ultragray_studies.report import train_and_evaluate

OUTPUT = FIGURES["ablations"].staged
SEEDS = (0, 1, 2)
SHORTER = {"steps": 400, "max_gaussians": 40_000, "confidence": False}  # than `fast`, so that an hour is enough
TEXTURES = (0.0, 0.05, 0.2, 0.5)


@dataclass(frozen=True, eq=False)
class Variation:
    """Trainings with some settings changed."""

    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)


AS_IT_IS = Variation("as it is")
WITHOUT = (
    AS_IT_IS,
    Variation("no views between frames", {"views_between": 0.0}),
    Variation("no shift out of the plane", {"out_of_plane_mm": 0.0}),
    Variation("no floor in shadows", {"intensity_floor": 0.0}),
    Variation("absorption has no price", {"absorption_penalty": 0.0}),
    Variation("no absorption", {"transmittance": False}),
    Variation("random start", {"start": "random"}),
)
CURVE = tuple(
    AS_IT_IS if value == TEXTURE else Variation(f"texture {value:g}", {"texture": value}) for value in TEXTURES
)
SOURCES = {
    "ultranerf_liver_other_side": ("ultranerf_liver", SourceOptions("0:90", "90:180")),
    "spine_phantom": ("spine_phantom", SourceOptions()),
    "nwire_phantom": ("nwire_phantom", SourceOptions()),
    "phantom": (PHANTOM, SourceOptions()),
}

log = logging.getLogger("ablations")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("data_folder", type=Path, help="folder of the data sets")
    parser.add_argument("--only", nargs="+", choices=SOURCES, default=list(SOURCES), help="leave out the others")
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    for name in arguments.only:
        folder, options = SOURCES[name]
        dataset = load_dataset(folder if folder == PHANTOM else arguments.data_folder / folder, options)
        for variation in dict.fromkeys((*WITHOUT, *CURVE)):
            for seed in SEEDS:
                measure(name, dataset, variation, seed)


def measure(name: str, dataset: Dataset, variation: Variation, seed: int) -> None:
    """One training, into the file, unless that holds it from this commit."""
    key, head = f"{variation.name}, seed {seed}", measured(torch.get_num_threads())
    config = TrainingConfig.preset("fast", **{**SHORTER, **variation.settings}, seed=seed)
    known = read().get(name, {}).get(key, {})
    if known and known["config"] == config.to_dict() and is_of_commit(known, head["commit"]):
        return
    trained = train_and_evaluate(dataset, config)
    figures = {
        **trained.evaluation.mean.to_dict(),
        **trained.evaluation.speckle.figures(),
        "measured": head,
        "config": config.to_dict(),
    }
    if dataset.name == PHANTOM:
        shadow = BoneShadow.of(dataset.val)
        figures["shadow_mae"] = shadow.mean_absolute_error(render_sweep(trained.scene, dataset.val))
    log.info("%s, %s: %.2f dB", name, key, figures["psnr_db"])
    everything = read()
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    everything.setdefault(name, {})[key] = figures
    write_whole(OUTPUT, json.dumps(everything, indent=1, allow_nan=False) + "\n")


def is_of_commit(figures: Document, commit: str | None) -> bool:
    """Whether figures were taken at a commit, without changes to it."""
    return commit is not None and not commit.endswith(DIRTY) and figures["measured"]["commit"] == commit


def read() -> dict[str, dict[str, Any]]:
    """Figures by set, variation and seed."""
    return json.loads(OUTPUT.read_text()) if OUTPUT.exists() else {}


def tables(figures: Document) -> Iterator[str]:
    """Trainings without one part each, then the curve of texture."""
    steps, count = SHORTER["steps"], SHORTER["max_gaussians"]
    yield f"Trainings without one part each, of {steps} steps and {count:,} Gaussians: less than for the figures above."
    yield f"PSNR (dB) and MS-SSIM on held-out frames, mean and standard deviation over {len(SEEDS)} seeds; then, where"
    yield "it is known, the mean absolute error in the shadow of bone."
    yield ""
    yield f"| | {' | '.join(figures)} |"
    yield f"|---{'|---' * len(figures)}|"
    for variation in WITHOUT:
        cells = [_cell(runs, variation, ("psnr_db", "ms_ssim", "shadow_mae")) for runs in figures.values()]
        yield f"| {variation.name} | {' | '.join(cells)} |"
    yield ""
    yield "The share of SSIM in the loss (`texture`): PSNR, MS-SSIM and GMSD on held-out frames, and the contrast of"
    yield "speckle (std/mean of the envelope), rendered and true:"
    yield ""
    yield f"| | {' | '.join(figures)} |"
    yield f"|---{'|---' * len(figures)}|"
    for variation in CURVE:
        keys = ("psnr_db", "ms_ssim", "gmsd", "speckle_contrast", "true_speckle_contrast")
        cells = [_cell(runs, variation, keys) for runs in figures.values()]
        yield f"| {variation.name} | {' | '.join(cells)} |"


def _cell(runs: Mapping[str, Any], variation: Variation, keys: tuple[str, ...]) -> str:
    seeds = [runs[key] for seed in SEEDS if (key := f"{variation.name}, seed {seed}") in runs]
    parts = []
    for key in keys:
        values = [one[key] for one in seeds if key in one]
        if values:
            digits = {"psnr_db": 2, "shadow_mae": 4}.get(key, 3)
            parts.append(f"{np.mean(values):.{digits}f} ± {np.std(values):.{digits}f}")
    return " / ".join(parts) or "–"


if __name__ == "__main__":
    main()
