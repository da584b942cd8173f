"""Trains and measures on tracked and simulated sweeps: `make results`.

    python benchmarks/results_tables.py DATA_FOLDER [--only NAME ...]

Each run's figures go into the JSON as soon as it is done, so that a killed run keeps them. The tables of
docs/results.md and README.md come from it.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import torch

from in_silico import IN_SILICO
from registry import FIGURES, Document
from ultragray.datasets.source import PHANTOM, SourceOptions, load_dataset
from ultragray.files import write_whole
from ultragray.learn.evaluation.baselines import BASELINES, affordable_voxel_mm, evaluate_baselines, predict
from ultragray.learn.evaluation.scoring import render_sweep
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import Progress, TrainingConfig
from ultragray.phantom.imaging import SHADOW_DB, BoneShadow
from ultragray.scene.gaussians import GaussianScene
from ultragray_studies.bench.report import measured
from ultragray_studies.report import train_and_evaluate

SECONDS_PER_LINE = 15.0
THIRD, BAND_SPACINGS = 3, 10
METRICS = ("psnr_db", "ms_ssim", "gms", "gmsd")
ROW_NAMES = {
    "scene": "**scene**",
    "median": "median compounding",
    "mean": "mean compounding",
    "maximum": "maximum compounding",
    "linear": "linear between frames",
    "nearest": "nearest training frame",
}

README_ROWS = {
    "ultranerf_liver": "simulated liver, trained on two sweeps",
    "liver_convex": "human liver, convex probe",
    "spine_phantom": "spine phantom, 17 frames",
    "nwire_phantom": "N-wire phantom: bright dots in black",
    "phantom": "built-in phantom, an unseen tilt",
}

log = logging.getLogger("results")


class Part(Enum):
    """The frames of a dataset that a run trains from."""

    WHOLE = "all"
    THIRD = "every third"  # the others are held out
    BAND = "all but a band"  # of ten spacings in the middle of the sweep, which is held out


@dataclass(frozen=True)
class Run:
    """One training. `source` is a folder of the data folder, the word phantom, or a name of IN_SILICO."""

    name: str
    source: str
    part: Part = Part.WHOLE
    preset: str = "fast"
    options: SourceOptions = field(default_factory=SourceOptions)
    settings: Mapping[str, Any] = field(default_factory=dict)


RUNS = (
    Run("ultranerf_liver", "ultranerf_liver"),
    Run("ultranerf_liver_other_side", "ultranerf_liver", options=SourceOptions("0:90", "90:180")),
    Run("liver_convex", "liver_convex"),
    Run("spine_phantom", "spine_phantom"),
    Run("nwire_phantom", "nwire_phantom"),
    Run("phantom", PHANTOM),
    *(Run(name, name) for name in ("robot", "fourth tilt +6°", "fourth tilt +18°")),
    *(
        Run(f"{name}, {part.value}", name, part)
        for name in ("ultranerf_liver", "liver_convex", "spine_phantom", "nwire_phantom")
        for part in (Part.THIRD, Part.BAND)
    ),
    *(Run(f"{name}, preset best", name, preset="best") for name in ("nwire_phantom", "spine_phantom")),
    Run(
        "ultranerf_liver_paper",
        "ultranerf_liver",
        preset="paper",
        settings={"steps": 1_000, "initial_gaussians": 30_000, "max_gaussians": 60_000},
    ),
)


def main() -> None:
    arguments = _parser().parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    output: Path = arguments.figures
    output.parent.mkdir(parents=True, exist_ok=True)
    figures = json.loads(output.read_text()) if output.exists() else {}
    for run in RUNS:
        if arguments.only is None or run.name in arguments.only:
            figures[run.name] = measure(run, arguments.data_folder)
            write_whole(output, json.dumps(figures, indent=1, allow_nan=False) + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("data_folder", type=Path, help="folder of the data sets")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=[run.name for run in RUNS],
        help="leave out the others",
    )
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    parser.add_argument(
        "--figures", type=Path, default=FIGURES["results_tables"].staged, help="JSON; keeps the runs it has"
    )
    return parser


def measure(run: Run, data_folder: Path) -> dict[str, Any]:
    """Trains and measures one run, and the baselines on the same frames."""
    head = measured(torch.get_num_threads())
    dataset = part_of(_source(run, data_folder), run.part)
    voxel_mm = affordable_voxel_mm(dataset.train)
    log.info("%s: baselines", run.name)
    baselines = evaluate_baselines(dataset, BASELINES, voxel_mm)
    config = TrainingConfig.preset(run.preset, **run.settings)
    trained = train_and_evaluate(dataset, config, report=_teller(run.name))
    log.info("%s: %.2f dB in %.0f s", run.name, trained.evaluation.mean.psnr_db, trained.course.seconds)
    evaluations = {"scene": trained.evaluation, **baselines}
    figures = {
        "train_frames": len(dataset.train),
        "val_frames": len(dataset.val),
        "image": f"{dataset.train.height}x{dataset.train.width}",
        "split": {"train": run.options.train_frames, "val": run.options.val_frames},
        "ms_ssim_scales": trained.evaluation.ms_ssim_scales,
        "voxel_mm": voxel_mm,
        "metrics": {
            name: {"mean": evaluation.mean.to_dict(), "std": evaluation.std.to_dict()}
            for name, evaluation in evaluations.items()
        },
        "preset": run.preset,
        "settings": dict(run.settings),
        "steps": trained.scene.info.training["steps"],
        "gaussians": trained.scene.gaussian_count,
        "step_ms": 1000.0 * trained.course.step_s,
        "total_s": trained.course.seconds,
        "measured": head,
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


def _teller(name: str) -> Callable[[Progress], None]:
    told_at = time.monotonic()

    def tell(progress: Progress) -> None:
        nonlocal told_at
        if time.monotonic() - told_at >= SECONDS_PER_LINE:
            told_at = time.monotonic()
            log.info("%s: step %d of %d, loss %.4f", name, progress.step, progress.steps, progress.loss)

    return tell


def tables(figures: Document) -> Iterator[str]:
    """One table of the trainings, one of each run's lead, then one of the metrics for each run."""
    known = {run.name: figures[run.name] for run in RUNS if run.name in figures}
    yield "| run | training / held-out frames | image | preset | steps | Gaussians | ms a step | total |"
    yield "|---|---|---|---|---|---|---|---|"
    for name, run in known.items():
        yield (
            f"| {name} | {run['train_frames']} / {run['val_frames']} | {run['image']} | {run['preset']} "
            f"| {run['steps']:,} | {run['gaussians']:,} | {run['step_ms']:.0f} | {run['total_s']:.0f} s |"
        )
    yield ""
    yield from _comparison(known)
    for name, run in known.items():
        yield from _metrics_table(name, run)


def glanced_at(figures: Document) -> Document:
    """The runs that the README shows."""
    return {name: figures[name] for name in README_ROWS if name in figures}


def at_a_glance(figures: Document) -> Iterator[str]:
    """The README's table, of the runs that it shows."""
    yield "| PSNR, MS-SSIM, GMSD | training | this scene | median compounding | linear interpolation |"
    yield "|---|---|---|---|---|"
    for name, run in figures.items():
        means = [run["metrics"][method]["mean"] for method in ("scene", "median", "linear")]
        cells = [f"{mean['psnr_db']:.1f} dB, {mean['ms_ssim']:.3f}, {mean['gmsd']:.3f}" for mean in means]
        yield f"| {README_ROWS[name]} | {run['total_s']:.0f} s | {' | '.join(cells)} |"


def _comparison(known: Mapping[str, Any]) -> list[str]:
    """Each run's scene against the better of median compounding and linear interpolation, metric by metric."""
    lines = [
        "The scene less the better of median compounding and linear interpolation (GMSD: the better less the scene, so",
        "that more is better throughout):",
        "",
        "| run | PSNR, dB | MS-SSIM | GMS | GMSD |",
        "|---|---|---|---|---|",
    ]
    for name, run in known.items():
        means = {method: run["metrics"][method]["mean"] for method in ("scene", "median", "linear")}
        cells = []
        for key in METRICS:
            sign = -1.0 if key == "gmsd" else 1.0
            lead = min(sign * (means["scene"][key] - means[method][key]) for method in ("median", "linear"))
            cells.append(f"{lead:+.2f}" if key == "psnr_db" else f"{lead:+.3f}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return [*lines, ""]


def _metrics_table(name: str, run: Mapping[str, Any]) -> list[str]:
    means = {method: run["metrics"][method]["mean"] for method in ROW_NAMES}
    best = {key: (min if key == "gmsd" else max)(mean[key] for mean in means.values()) for key in METRICS}
    notes = [f"Compounding with voxels of {run['voxel_mm']:g} mm."]
    if run["split"]["train"]:
        notes.append(f"Training frames {run['split']['train']}, held out {run['split']['val']} of the training file.")
    if run["ms_ssim_scales"] < 5:
        notes.append(f"MS-SSIM over {run['ms_ssim_scales']} scales, which is what the images hold.")
    if run["settings"]:
        settings = ", ".join(f"{key} {value:,}" for key, value in run["settings"].items())
        notes.append(f"Preset {run['preset']} with {settings}.")
    lines = [
        f"## {name}",
        "",
        "| held-out frames | PSNR, dB | MS-SSIM | GMS | GMSD |",
        "|---|---|---|---|---|",
    ]
    for method, row_name in ROW_NAMES.items():
        std = run["metrics"][method]["std"]
        cells = []
        for key in METRICS:
            digits = 2 if key == "psnr_db" else 3
            mean = f"{means[method][key]:.{digits}f}"
            shown = f"**{mean}**" if mean == f"{best[key]:.{digits}f}" else mean
            cells.append(f"{shown} ± {std[key]:.{digits}f}")
        lines.append(f"| {row_name} | {' | '.join(cells)} |")
    return [*lines, "", " ".join(notes), "", *_shadow_lines(run)]


def _shadow_lines(run: Mapping[str, Any]) -> list[str]:
    if "shadow" not in run:
        return []
    shadow = run["shadow"]
    return [
        f"Where bone takes more than {SHADOW_DB:g} dB: mean absolute error {shadow['scene_mae']:.4f} (scene) against "
        f"{shadow['median_mae']:.4f} (median compounding);",
        f"mean transmittance of the scene {shadow['scene_transmittance']:.3f}.",
        "",
    ]


if __name__ == "__main__":
    main()
