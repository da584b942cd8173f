"""The measurements of a report: a trained scene, the baselines, the ablations of the paper, and growing tilt."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from ultragray.errors import DatasetInvalid, UltragrayError
from ultragray.geometry.pose import rotation_angles_deg
from ultragray.geometry.probe import FloatArray
from ultragray.learn.evaluation.baselines import FOLDS as VOLUME_METHODS
from ultragray.learn.evaluation.baselines import VOXEL_MM, evaluate_baselines, mean_axes, nearest_frames
from ultragray.learn.evaluation.scoring import Evaluation, evaluate, require_frames
from ultragray.learn.sweep import Dataset, IntArray, Sweep
from ultragray.learn.training import Progress, TrainingConfig, train
from ultragray.scene.gaussians import GaussianScene
from ultragray_studies.comparison.result import Comparison
from ultragray_studies.comparison.run import SCENE
from ultragray_studies.methods.classical import Compounding, FromFrames
from ultragray_studies.methods.gaussians import SceneMethod
from ultragray_studies.methods.method import Method

LEAST_TILT_DEG = 3.0  # a sweep that turns less cannot show what tilting costs
TILT_BASELINES = ("median", "nearest")
GAUSSIAN_SHARES = {"a quarter of the Gaussians": 0.25, "half of the Gaussians": 0.5, "twice the Gaussians": 2.0}
Report = Callable[[Progress], None]
Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Trained:
    """A scene, what it reaches on the held-out frames, and how its training went."""

    scene: GaussianScene
    evaluation: Evaluation
    seconds: float  # of the whole training
    step_s: float  # of a step, the mean over the run
    losses: list[float]  # of each step
    val_psnr_db: dict[int, float]  # by step, over some held-out frames


@dataclass(frozen=True, eq=False)
class TiltStudy:
    """A scene trained on one half of the tilts of a sweep and measured on the other half."""

    train_tilts_deg: tuple[float, float]  # least and greatest
    val_tilts_deg: tuple[float, float]
    angles_deg: FloatArray  # [F] of each held-out frame to the nearest training frame
    evaluations: dict[str, Evaluation]  # "scene" and TILT_BASELINES


@dataclass(frozen=True)
class Failed:
    """A study that could not be finished."""

    reason: str


def attempt(study: Callable[[], Result]) -> Result | Failed:
    """The result of `study`, or why there is none: a study that fails must not end the others."""
    try:
        return study()
    except UltragrayError as error:
        return Failed(str(error))


def train_and_evaluate(dataset: Dataset, config: TrainingConfig, *, report: Report | None = None) -> Trained:
    """Trains on `dataset.train`, without the fit of a confidence, and measures on `dataset.val`.

    Raises DatasetInvalid where that has no frames.
    """
    require_frames(dataset.val)
    losses: list[float] = []
    val_psnr_db: dict[int, float] = {}

    def follow(progress: Progress) -> None:
        losses.append(progress.loss)
        if progress.val_psnr_db is not None and progress.val_step is not None:
            val_psnr_db[progress.val_step] = progress.val_psnr_db
        if report is not None:
            report(progress)

    started = time.perf_counter()
    scene = train(dataset, replace(config, confidence=False), report=follow)
    seconds = time.perf_counter() - started
    return Trained(
        scene=scene,
        evaluation=evaluate(scene, dataset.val),
        seconds=seconds,
        step_s=seconds / len(losses),
        losses=losses,
        val_psnr_db=val_psnr_db,
    )


def trained_of_journal(scene: GaussianScene, evaluation: Evaluation, journal: Path) -> Trained:
    """The same of a training that has finished: its scene, and the `metrics.jsonl` of its run. Raises OSError."""
    lines = [json.loads(line) for line in journal.read_text(encoding="utf-8").splitlines()]
    seconds = float(lines[-1]["elapsed_s"])
    return Trained(
        scene=scene,
        evaluation=evaluation,
        seconds=seconds,
        step_s=seconds / len(lines),
        losses=[line["loss"] for line in lines],
        val_psnr_db={line["step"]: line["val_psnr_db"] for line in lines if "val_psnr_db" in line},
    )


def ablations(config: TrainingConfig, gaussian_count: int) -> dict[str, TrainingConfig]:
    """The runs of the paper's ablation table, each a configuration that differs from `config` in one thing.

    `gaussian_count` is what the run with `config` has, of which some have a share.
    """

    def with_share_of_gaussians(share: float) -> TrainingConfig:
        limit = max(1, round(gaussian_count * share))
        start = config.initial_gaussians
        if start is not None:
            start = min(max(1, round(start * share)), limit)
        return replace(config, max_gaussians=limit, initial_gaussians=start)

    return {
        "no transmittance": replace(config, transmittance=False),
        "spherical harmonics of degree 0": replace(config, sh_degree=0),
        "no out-of-plane sampling": replace(config, out_of_plane_mm=0.0),
        **{name: with_share_of_gaussians(share) for name, share in GAUSSIAN_SHARES.items()},
    }


def baselines(voxel_mm: float) -> dict[str, Method]:
    """The classical methods of a report by name, with voxels of one size."""
    methods = (*(Compounding(fold, voxel_mm) for fold in VOLUME_METHODS), FromFrames("linear"), FromFrames("nearest"))
    return {method.name: method for method in methods}


def ablation_methods(config: TrainingConfig, gaussian_count: int) -> dict[str, Method]:
    """The runs of `ablations` as methods, to be compared with the scene."""
    return {
        name: SceneMethod(name=name, title=name, settings=changed.to_dict())
        for name, changed in ablations(config, gaussian_count).items()
    }


def scene_evaluation(comparison: Comparison) -> Evaluation:
    """The scores of the scene among the methods of a comparison. Raises DatasetInvalid where it has none."""
    if SCENE in comparison.failures:
        raise DatasetInvalid(
            f"{comparison.dataset.name}: the scene cannot be measured on it: {comparison.failures[SCENE]}"
        )
    return comparison.measured[SCENE]


def frame_tilts_deg(sweep: Sweep) -> FloatArray:  # [F]
    """Rotation of each frame against the mean, in degrees, about the axis that the sweep turns about most.

    Signed so that tilts grow along the sweep.
    """
    turned = mean_axes(sweep.poses).T @ sweep.poses[:, :3, :3]
    vectors = np.stack([turned[:, i, j] - turned[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1) / 2.0
    lengths = np.linalg.norm(vectors, axis=1)
    angles = np.arctan2(lengths, (np.trace(turned, axis1=1, axis2=2) - 1.0) / 2.0)
    vectors *= (np.degrees(angles) / np.maximum(lengths, 1e-12))[:, None]
    axis = np.linalg.svd(vectors)[2][0]
    tilts: FloatArray = vectors @ axis
    later = np.arange(len(tilts)) - (len(tilts) - 1) / 2.0
    return tilts if tilts @ later >= 0.0 else -tilts


def split_by_tilt(tilts_deg: FloatArray) -> tuple[IntArray, IntArray] | None:  # [F]
    """Places of the lower and of the upper half, each in the order of the sweep; None where the sweep hardly turns."""
    half = len(tilts_deg) // 2
    if half < 2 or np.ptp(tilts_deg) < LEAST_TILT_DEG:
        return None
    order = tilts_deg.argsort(kind="stable")
    return np.sort(order[:half]), np.sort(order[half:])


def study_tilt(
    sweep: Sweep, config: TrainingConfig, *, voxel_mm: float = VOXEL_MM, report: Report | None = None
) -> TiltStudy | None:
    """Trains on one half of a sweep's tilts and measures on the other; None where the sweep hardly turns."""
    tilts = frame_tilts_deg(sweep)
    halves = split_by_tilt(tilts)
    if halves is None:
        return None
    low, high = halves
    dataset = Dataset(name=f"{sweep.source} by tilt", train=sweep.select(low), val=sweep.select(high))
    nearest = nearest_frames(dataset.train, dataset.val.poses)
    angles = rotation_angles_deg(dataset.val.poses, dataset.train.poses)
    trained = train_and_evaluate(dataset, config, report=report)
    return TiltStudy(
        train_tilts_deg=(float(tilts[low].min()), float(tilts[low].max())),
        val_tilts_deg=(float(tilts[high].min()), float(tilts[high].max())),
        angles_deg=angles[np.arange(len(high)), nearest],
        evaluations={"scene": trained.evaluation, **evaluate_baselines(dataset, TILT_BASELINES, voxel_mm)},
    )
