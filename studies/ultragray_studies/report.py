"""Reports: a scene beside the baselines, the ablations of the paper and growing tilt, measured alike, on one HTML page.

First what is measured, then the page. `ultragray report` makes both.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from ultragray.errors import UltragrayError
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import mean_axes, turns_of
from ultragray.learn.evaluation.baselines import FOLDS as VOLUME_METHODS
from ultragray.learn.evaluation.baselines import VOXEL_MM, evaluate_baselines
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation, evaluate, require_frames
from ultragray.learn.report.page import Prediction, ScenePage, render_page
from ultragray.learn.report.tables import Row, metric_rows
from ultragray.learn.sweep import Dataset, Distances, IntArray, Sweep
from ultragray.learn.training import Progress, TrainingConfig, train
from ultragray.learn.training.progress import Course
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import read_header
from ultragray_studies.comparison.page import plot_counts, plot_distances, plot_tilt
from ultragray_studies.comparison.result import Comparison, MethodResult
from ultragray_studies.comparison.run import SCENE, frames_of
from ultragray_studies.methods.classical import Compounding, FromFrames, InTime
from ultragray_studies.methods.gaussians import SCENE_FILE, SceneMethod
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
    course: Course


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
    course = Course(time.perf_counter() - started, losses, val_psnr_db)
    return Trained(scene, evaluate(scene, dataset.val), course)


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
    frames = (FromFrames("linear"), FromFrames("nearest"), InTime())
    return {method.name: method for method in (*(Compounding(fold, voxel_mm) for fold in VOLUME_METHODS), *frames)}


def ablation_methods(config: TrainingConfig, gaussian_count: int) -> dict[str, Method]:
    """The runs of `ablations` as methods, to be compared with the scene."""
    return {
        name: SceneMethod(name=name, title=name, settings=changed.to_dict())
        for name, changed in ablations(config, gaussian_count).items()
    }


def frame_tilts_deg(sweep: Sweep) -> FloatArray:  # [F]
    """Rotation of each frame against the mean, in degrees, about the axis that the sweep turns about most.

    Signed so that tilts grow along the sweep.
    """
    vectors = np.degrees(turns_of(mean_axes(sweep.poses).T @ sweep.poses[:, :3, :3]))
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
    trained = train_and_evaluate(dataset, config, report=report)
    return TiltStudy(
        train_tilts_deg=(float(tilts[low].min()), float(tilts[low].max())),
        val_tilts_deg=(float(tilts[high].min()), float(tilts[high].max())),
        angles_deg=Distances.of(dataset).deg,
        evaluations={"scene": trained.evaluation, **evaluate_baselines(dataset, TILT_BASELINES, voxel_mm)},
    )


NOT_PLOTTED = ("mean-", "maximum-")  # over the frames, where their lines would hide those of the median


@dataclass(frozen=True, eq=False)
class ReportContent:
    """Contents of a report. `course` is None for a scene that was read from a file; a part that failed says why.

    `comparison` holds the scene, under the name `scene`, the methods it is compared with, and the `ablations`; its
    folder their frames.
    """

    dataset: Dataset
    scene: GaussianScene
    comparison: Comparison
    folder: Path
    course: Course | None = None
    ablations: tuple[str, ...] = ()  # rows of the comparison
    tilt: TiltStudy | Failed | None = None

    @property
    def compared(self) -> list[MethodResult]:
        """The rows of the comparison that are no ablations."""
        return [one for one in self.comparison.results if one.name not in self.ablations]

    def gaussian_count(self, name: str) -> int:
        """That of an ablation."""
        return read_header(self.folder / name / SCENE_FILE).info.gaussian_count


def render_report(content: ReportContent) -> str:
    """The HTML text."""
    compared = {one: one.evaluation for one in content.compared if one.evaluation is not None}
    page = ScenePage(
        content.dataset,
        content.scene,
        {
            one.description.title: Prediction(evaluation, frames_of(content.folder, one.name), one.on_path)
            for one, evaluation in compared.items()
        },
        content.comparison.machine,
        course=content.course,
        failures={one.description.title: one.failure for one in content.compared if one.failure is not None},
        not_plotted=frozenset(one.description.title for one in compared if one.name.startswith(NOT_PLOTTED)),
    )
    evaluations = {one.description.title: evaluation for one, evaluation in compared.items()}
    tilt = content.tilt if isinstance(content.tilt, TiltStudy) else None
    return render_page(
        page,
        "report.html",
        __package__,
        distance_plot=plot_distances(evaluations, content.comparison.distances),
        ablations=_ablation_rows(content),
        counts_plot=_counts_plot(content),
        tilt=tilt,
        tilt_failure=content.tilt.reason if isinstance(content.tilt, Failed) else None,
        tilt_plot=None if tilt is None else plot_tilt(tilt.angles_deg, tilt.evaluations),
        tilt_rows=[] if tilt is None else metric_rows(tilt.evaluations),
    )


def _ablation_rows(content: ReportContent) -> list[Row]:
    """The full model where it was trained, then each ablation in its order."""
    evaluations: dict[str, Evaluation] = {}
    notes: dict[str, list[str]] = {}
    failures: dict[str, str] = {}

    def add(name: str, evaluation: Evaluation, gaussian_count: int, step_s: float) -> None:
        evaluations[name], notes[name] = evaluation, [f"{gaussian_count:,}", f"{1000.0 * step_s:.0f}"]

    if content.ablations and content.course is not None:
        add("full model", content.comparison.measured[SCENE], content.scene.gaussian_count, content.course.step_s)
    for one in content.comparison.results:
        if one.name in content.ablations:
            if one.evaluation is not None:
                step_s = one.cost.seconds / one.cost.steps
                add(one.name, one.evaluation, content.gaussian_count(one.name), step_s)
            failures |= {} if one.failure is None else {one.name: one.failure}
    rows = {row.name: row for row in metric_rows(evaluations, notes)}
    rows |= {name: Row(name, failure=reason) for name, reason in failures.items()}
    return [rows[name] for name in ("full model", *content.ablations) if name in rows]


def _counts_plot(content: ReportContent) -> str | None:
    """Over the runs that differ in their number of Gaussians only."""
    measured = content.comparison.measured
    shares = [name for name in GAUSSIAN_SHARES if name in content.ablations and name in measured]
    points: dict[int, FrameMetrics] = {content.gaussian_count(name): measured[name].mean for name in shares}
    if content.course is not None:
        points[content.scene.gaussian_count] = measured[SCENE].mean
    return plot_counts(points) if len(points) > 1 else None
