"""Trains and measures on tracked and simulated sweeps, beside classical methods: `make results`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bone_shadow import SHADOW_DB, BoneShadow
from in_silico import IN_SILICO
from measuring import Document, Lines, columns, measure_runs, table, teller
from ultragray.datasets.source import PHANTOM, SourceOptions, load_dataset
from ultragray.learn.evaluation.baselines import BASELINES, IN_TIME, affordable_voxel_mm, evaluate_baselines, predict
from ultragray.learn.evaluation.scoring import Evaluation, evaluate, evaluate_frames, render_sweep
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.agreement import agreed_path
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
    evaluations = {"scene": trained.evaluation, **baselines, **_on_path(trained.scene, dataset)}
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


def _on_path(scene: GaussianScene, dataset: Dataset) -> dict[str, Evaluation]:
    """The scene and linear interpolation by the path that neighbouring frames agree with, which takes no image of a
    held-out frame; empty where the poses are on it."""
    path = agreed_path(dataset)
    if path is None or (placed := path.of(dataset)) is dataset:
        return {}
    linear = predict(placed.train, placed.val.poses, "linear")
    return {
        "scene_on_path": evaluate(scene.at_rest(), placed.val),
        "linear_on_path": evaluate_frames(linear, placed.val),
    }


def _source(run: Run, data_folder: Path) -> Dataset:
    if run.source in IN_SILICO:
        case = IN_SILICO[run.source]()
        return Dataset(run.source, train=case.training, val=case.unseen)
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


ROW_NAMES = {
    "scene": "**scene**",
    "median": "median compounding",
    "mean": "mean compounding",
    "maximum": "maximum compounding",
    "linear": "linear between frames",
    "nearest": "nearest training frame",
    IN_TIME: "neighbours in time",
    "scene_on_path": "**scene, on the path**",
    "linear_on_path": "linear, on the path",
}
README_ROWS = {
    "ultranerf_liver": "simulated liver, trained on two sweeps",
    "liver_convex": "human liver, convex probe",
    "spine_phantom": "spine phantom, 17 frames",
    "nwire_phantom": "N-wire phantom: bright dots in black",
    "phantom": "built-in phantom, an unseen tilt",
}
_HEADS = {"psnr_db": "PSNR, dB", "ms_ssim": "MS-SSIM", "gms": "GMS", "gmsd": "GMSD"}
_LESS_IS_BETTER = "gmsd"


def results(figures: Document) -> Lines:
    """A table of the trainings, one of each run's lead, then one of the metrics for each run."""
    known = {name: figures[name] for name in RUNS if name in figures}
    yield from columns(
        ({"name": name, **run} for name, run in known.items()),
        {
            "run": "{name}",
            "training / held-out frames": "{train_frames} / {val_frames}",
            "image": "{image}",
            "preset": "{preset}",
            "steps": "{steps:,}",
            "Gaussians": "{gaussians:,}",
            "ms a step": "{step_ms:.0f}",
            "total": "{total_s:.0f} s",
        },
    )
    yield from (
        "",
        "The scene less the better of median compounding and linear interpolation (GMSD: the better less the scene, so",
        "that more is better throughout):",
        "",
    )
    yield from table(("run", *_HEADS.values()), ((name, *_leads(run)) for name, run in known.items()))
    yield ""
    for name, run in known.items():
        yield from (f"## {name}", "")
        yield from table(("held-out frames", *_HEADS.values()), _metrics(run))
        yield from ("", " ".join(_notes(run)), "")
        if (shadow := run.get("shadow")) is not None:
            yield (
                f"Where bone takes more than {SHADOW_DB:g} dB: mean absolute error {shadow['scene_mae']:.4f} (scene) "
                f"against {shadow['median_mae']:.4f} (median compounding);"
            )
            yield from (f"mean transmittance of the scene {shadow['scene_transmittance']:.3f}.", "")


def _leads(run: Document) -> Iterator[str]:
    """The scene against the better of median compounding and linear interpolation, metric by metric."""
    means = {method: run["metrics"][method]["mean"] for method in ("scene", "median", "linear")}
    for key in _HEADS:
        sign = -1.0 if key == _LESS_IS_BETTER else 1.0
        lead = min(sign * (means["scene"][key] - means[method][key]) for method in ("median", "linear"))
        yield f"{lead:+.{_digits(key)}f}"


def _digits(key: str) -> int:
    return 2 if key == "psnr_db" else 3


def _metrics(run: Document) -> Iterator[list[str]]:
    known = {method: name for method, name in ROW_NAMES.items() if method in run["metrics"]}
    means = {method: run["metrics"][method]["mean"] for method in known}
    best = {key: (min if key == _LESS_IS_BETTER else max)(mean[key] for mean in means.values()) for key in _HEADS}
    for method, row_name in known.items():
        cells = [row_name]
        for key in _HEADS:
            mean = f"{means[method][key]:.{_digits(key)}f}"
            text = f"**{mean}**" if mean == f"{best[key]:.{_digits(key)}f}" else mean
            cells.append(f"{text} ± {run['metrics'][method]['std'][key]:.{_digits(key)}f}")
        yield cells


def _notes(run: Document) -> Iterator[str]:
    yield f"Compounding with voxels of {run['voxel_mm']:g} mm."
    if run["split"]["train"]:
        yield f"Training frames {run['split']['train']}, held out {run['split']['val']} of the training file."
    if run["ms_ssim_scales"] < 5:
        yield f"MS-SSIM over {run['ms_ssim_scales']} scales, which is what the images hold."
    if run["settings"]:
        settings = ", ".join(f"{key} {value:,}" for key, value in run["settings"].items())
        yield f"Preset {run['preset']} with {settings}."


def glanced_at(figures: Document) -> Document:
    """The runs that the README shows."""
    return {name: figures[name] for name in README_ROWS if name in figures}


def results_at_a_glance(figures: Document) -> Lines:
    """The README's table, of the runs that it shows."""
    text = "{psnr_db:.1f} dB, {ms_ssim:.3f}, {gmsd:.3f}"
    return table(
        ("PSNR, MS-SSIM, GMSD", "training", "this scene", "median compounding", "linear interpolation"),
        (
            (
                *(README_ROWS[name], f"{run['total_s']:.0f} s"),
                *(text.format_map(run["metrics"][one]["mean"]) for one in ("scene", "median", "linear")),
            )
            for name, run in figures.items()
        ),
    )


if __name__ == "__main__":
    measure_runs("results_tables", __doc__, {name: partial(measure, name) for name in RUNS})
