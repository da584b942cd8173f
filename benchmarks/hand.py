"""The sweep of a hand, in silico: what each error of its poses costs, and what the agreed path regains: `make hand`."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch

from measuring import Document, Lines, measure_runs, table
from poses import deviation
from ultragray.learn.evaluation.baselines import IN_TIME, predict_held_out
from ultragray.learn.evaluation.held_out import score_held_out
from ultragray.learn.evaluation.metrics import frame_metrics, mean_and_std
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.agreement import agreed_path
from ultragray_studies.hand import Errors, HandSweep
from ultragray_studies.report import train_and_evaluate

SWEEPS = {"one pass": ((0.0,), 121), "two that cross": ((0.0, 80.0), 81)}  # directions, degrees; frames of each
ALL = Errors(0.13, 0.1, 0.1, 0.05, 50.0, 1.0, 2.0, 1.0)
ERRORS = {
    "none": Errors(),
    "noise of 0.05 mm and 0.05°": Errors(noise_mm=0.05, noise_deg=0.05),
    "noise of 0.13 mm and 0.1°": Errors(noise_mm=0.13, noise_deg=0.1),
    "noise of 0.3 mm and 0.5°": Errors(noise_mm=0.3, noise_deg=0.5),
    "wander of 0.1 mm and 0.05°": Errors(wander_mm=0.1, wander_deg=0.05),
    "wander of 0.3 mm and 0.2°": Errors(wander_mm=0.3, wander_deg=0.2),
    **{f"delay of {ms} ms": Errors(delay_ms=ms) for ms in (20, 50, 100)},
    "calibration off by 1 mm and 2°": Errors(calibration_mm=1.0, calibration_deg=2.0),
    "tissue that goes along": Errors(tissue=1.0),
    "all together": ALL,
}
LEAST_COST_DB = 0.1  # of a smaller one no share is told
UNITS = (("mm", " mm"), ("deg", "°"))
TRAINED = {  # scenes, by the names of their runs
    "scene, none": ("one pass", "none"),
    "scene, noise of 0.13 mm and 0.1°": ("one pass", "noise of 0.13 mm and 0.1°"),
    "scene, all together": ("one pass", "all together"),
    "scene of two passes, wander": ("two that cross", "wander of 0.3 mm and 0.2°"),
    "scene of two passes, all together": ("two that cross", "all together"),
}


def measure(sweep: str, error: str, data_folder: Path) -> Document:
    """Held-out frames predicted linearly by three kinds of poses, and what is left of the poses' errors."""
    recording, true = _recorded(sweep, error), _recorded(sweep, "none")
    began_s = time.perf_counter()
    path = agreed_path(recording)
    seconds = time.perf_counter() - began_s
    if path is None:
        raise AssertionError("a sweep of a hand has three frames in a row")
    with_true = replace(
        recording,
        train=replace(recording.train, poses=true.train.poses),
        val=replace(recording.val, poses=true.val.poses),
    )
    return {
        "as_given": _scores(recording, "linear"),
        "on_path": _scores(path.of(recording), "linear"),
        "true_poses": _scores(with_true, "linear"),
        "without_error": _scores_without_error(sweep),
        "in_time": _scores(recording, IN_TIME),
        "error": deviation(true.train, recording.train.poses),
        "left": deviation(true.train, path.train),
        "noise_mm": path.noise.position_mm,
        "noise_deg": path.noise.turn_deg,
        "delay_ms": 1000.0 * path.delay_s,
        "is_calibrated": not np.array_equal(path.calibration, np.eye(4)),
        "shares": list(path.shares),
        "seconds": seconds,
    }


def measure_scene(sweep: str, error: str, data_folder: Path) -> Document:
    """Scenes by the preset fast, without the agreed path and on it."""
    recording, scores = _recorded(sweep, error), {}
    for mode in ("none", "path"):
        trained = train_and_evaluate(recording, TrainingConfig.preset("fast", refine_poses=mode))
        rows = score_held_out(trained.scene, recording, trained.evaluation).to_dict()
        scores[mode] = {name: row["mean"] for name, row in rows.items() if row is not None}
    return scores


def _recorded(sweep: str, error: str) -> Dataset:
    return HandSweep.of(*SWEEPS[sweep]).recorded(ERRORS[error])


@lru_cache
def _scores_without_error(sweep: str) -> Document:
    return _scores(_recorded(sweep, "none"), "linear")


def _scores(dataset: Dataset, method: str) -> Document:
    truth = torch.from_numpy(dataset.val.images).float() / 255.0
    return mean_and_std(frame_metrics(torch.from_numpy(predict_held_out(dataset, method)), truth))[0].to_dict()


RUNS = {f"{sweep}, {error}": partial(measure, sweep, error) for sweep in SWEEPS for error in ERRORS}
SCENES = {name: partial(measure_scene, *trained) for name, trained in TRAINED.items()}


def of_paths(figures: Document) -> Document:
    """The runs without trainings."""
    return {name: run for name, run in figures.items() if name in RUNS}


def of_scenes(figures: Document) -> Document:
    """The trainings."""
    return {name: run for name, run in figures.items() if name in SCENES}


def predicted(figures: Document) -> Lines:
    """What each error costs a linear prediction, and what the path regains of it."""
    rows = []
    for sweep in SWEEPS:
        for error in ERRORS:
            if (run := figures.get(f"{sweep}, {error}")) is None:
                continue
            best, before, after, true = (
                run[name]["psnr_db"] for name in ("without_error", "as_given", "on_path", "true_poses")
            )
            cost_db = best - before
            regained = f"{(after - before) / cost_db:.0%}" if cost_db >= LEAST_COST_DB else ""
            scores = [f"{before:.2f} / {run['as_given']['gmsd']:.3f}", f"{after:.2f} / {run['on_path']['gmsd']:.3f}"]
            residuals = ", ".join(f"{run['error'][unit]:.2f} → {run['left'][unit]:.2f}{name}" for unit, name in UNITS)
            rows.append((sweep, error, *scores, f"{true:.2f}", regained, residuals, f"{run['in_time']['psnr_db']:.2f}"))
    head = ("sweep", "error", "as given", "on the path", "true poses", "regained", "error of poses", "in time")
    return table(head, rows)


def trained(figures: Document) -> Lines:
    """Scenes from the same sweeps."""
    rows = []
    for name, what in TRAINED.items():
        if (run := figures.get(name)) is not None:
            cells = [run["none"]["as_given"], run["path"]["as_given"], run["path"].get("on_path")]
            scores = ("" if one is None else f"{one['psnr_db']:.2f} / {one['gmsd']:.3f}" for one in cells)
            rows.append((*what, *scores))
    return table(("sweep", "error", "`none`, as given", "`path`, as given", "`path`, on the path"), rows)


if __name__ == "__main__":
    measure_runs("hand", __doc__, {**RUNS, **SCENES})
