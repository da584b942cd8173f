"""The page of a report: a comparison of a scene with others, and what is known of its training; one HTML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation, render_sweep
from ultragray.learn.report.pictures import FrameOfPage, Shown, frames_of_page, telling_places
from ultragray.learn.report.plots import plot_counts, plot_distances, plot_frames, plot_tilt, plot_training
from ultragray.learn.sweep import Dataset, spread_places
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import read_header
from ultragray_studies.comparison.page import environment
from ultragray_studies.comparison.place import frames_of
from ultragray_studies.comparison.result import Comparison, MethodResult
from ultragray_studies.comparison.run import SCENE
from ultragray_studies.comparison.tables import Row, metric_rows, rank_rows, speckle_rows
from ultragray_studies.methods.gaussians import SCENE_FILE
from ultragray_studies.report.study import GAUSSIAN_SHARES, Failed, TiltStudy, Trained

NOT_PLOTTED = ("mean-", "maximum-")  # over the frames, where their lines would hide those of the median
BESIDE = ("echo", "transmittance")  # what the rendering is made of


@dataclass(frozen=True, eq=False)
class ReportContent:
    """Contents of a report. `trained` is None for a scene that was read from a file; a part that failed says why.

    `comparison` holds the scene, under the name `scene`, the methods it is compared with, and the `ablations`; its
    folder their frames. `spread` is how many held-out frames are shown at most, from the first to the last; None: the
    worst, a typical one and the best.
    """

    dataset: Dataset
    scene: GaussianScene
    comparison: Comparison
    folder: Path
    scene_name: str | None = None
    spread: int | None = None
    trained: Trained | None = None
    ablations: tuple[str, ...] = ()  # rows of the comparison
    tilt: TiltStudy | Failed | None = None

    @property
    def compared(self) -> list[MethodResult]:
        """The rows of the comparison that are no ablations."""
        return [one for one in self.comparison.results if one.name not in self.ablations]

    @property
    def ablated(self) -> list[MethodResult]:
        """The others."""
        return [one for one in self.comparison.results if one.name in self.ablations]


def render_page(content: ReportContent) -> str:
    """The HTML text."""
    compared = {one.description.title: one.evaluation for one in content.compared if one.evaluation is not None}
    hidden = {one.description.title for one in content.compared if one.name.startswith(NOT_PLOTTED)}
    plotted = {title: evaluation for title, evaluation in compared.items() if title not in hidden}
    tilt = content.tilt if isinstance(content.tilt, TiltStudy) else None
    failed = [Row(one.description.title, failure=one.failure) for one in content.compared if one.failure is not None]
    is_alone = len(content.compared) == 1
    return (
        environment(__package__)
        .get_template("report.html")
        .render(
            content=content,
            facts=_facts(content),
            is_alone=is_alone,
            rows=[*metric_rows(compared), *failed],
            ranks=[] if is_alone else rank_rows(compared),
            speckle=speckle_rows(compared),
            scales=content.comparison.measured[SCENE].ms_ssim_scales,
            frames_plot=plot_frames(plotted),
            distance_plot=None if is_alone else plot_distances(compared, content.comparison.distances),
            training_plot=None if content.trained is None else plot_training(content.trained),
            pictures=_pictures(content),
            ablations=_ablation_rows(content),
            counts_plot=_counts_plot(content),
            tilt=tilt,
            tilt_failure=content.tilt.reason if isinstance(content.tilt, Failed) else None,
            tilt_plot=None if tilt is None else plot_tilt(tilt),
            tilt_rows=[] if tilt is None else metric_rows(tilt.evaluations),
            configuration=_configuration(content.trained),
        )
    )


def _configuration(trained: Trained | None) -> dict[str, Any]:
    """The settings of the training, without those that were not used."""
    settings = {} if trained is None else trained.scene.info.training
    return {name: value for name, value in settings.items() if value is not None}


def _facts(content: ReportContent) -> dict[str, str]:
    scene, facts = content.scene, content.comparison.dataset
    found = {
        **({} if content.scene_name is None else {"Scene": content.scene_name}),
        "Training frames": f"{facts.train_frames}",
        "Held-out frames": f"{facts.val_frames}",
        "Image": f"{facts.height} rows x {facts.width} scan lines",
        "Pixel": f"{facts.axial_mm:.2f} mm axial, {facts.lateral_mm:.2f} mm lateral in the middle",
        "Probe": facts.probe,
        "Gaussians": f"{scene.gaussian_count:,}, spherical harmonics of degree {scene.sh_degree}",
        "Intensity": scene.info.intensity,
    }
    if content.trained is not None:
        found["Training"] = (
            f"{content.trained.scene.info.training['steps']:,} steps in {content.trained.seconds:.0f} s, "
            f"{1000.0 * content.trained.step_s:.0f} ms a step"
        )
    return {**found, "Machine": content.comparison.machine}


def _ablation_rows(content: ReportContent) -> list[Row]:
    """The full model where it was trained, then each ablation in its order."""
    if not content.ablated:
        return []
    evaluations: dict[str, Evaluation] = {}
    notes: dict[str, list[str]] = {}
    if content.trained is not None:
        evaluations["full model"] = content.comparison.measured[SCENE]
        notes["full model"] = _training_notes(content.scene.gaussian_count, content.trained.step_s)
    for one in content.ablated:
        if one.evaluation is not None:
            evaluations[one.name] = one.evaluation
            notes[one.name] = _training_notes(_gaussian_count(content, one.name), one.seconds / one.steps)
    rows = {row.name: row for row in metric_rows(evaluations, notes)}
    rows |= {one.name: Row(one.name, failure=one.failure) for one in content.ablated if one.failure is not None}
    order = ["full model", *(one.name for one in content.ablated)]
    return [rows[name] for name in order if name in rows]


def _training_notes(gaussian_count: int, step_s: float) -> list[str]:
    return [f"{gaussian_count:,}", f"{1000.0 * step_s:.0f}"]


def _gaussian_count(content: ReportContent, name: str) -> int:
    return read_header(content.folder / name / SCENE_FILE).info.gaussian_count


def _counts_plot(content: ReportContent) -> str | None:
    """Over the runs that differ in their number of Gaussians only."""
    measured = content.comparison.measured
    points: dict[int, FrameMetrics] = {
        _gaussian_count(content, name): measured[name].mean
        for name in GAUSSIAN_SHARES
        if name in content.ablations and name in measured
    }
    if content.trained is not None:
        points[content.scene.gaussian_count] = measured[SCENE].mean
    return plot_counts(points) if len(points) > 1 else None


def _pictures(content: ReportContent) -> list[FrameOfPage]:
    """The chosen held-out frames: the scene, what its rendering is made of, and what it is compared with."""
    kinds: Mapping[int, str] = telling_places(content.comparison.measured[SCENE])
    if content.spread is not None:
        kinds = dict.fromkeys(spread_places(len(content.dataset.val), content.spread).tolist(), "")
    places = list(kinds)
    chosen = content.dataset.val.select(places)
    predictions = [
        Shown.prediction(one.description.title, frames_of(content.folder, one.name), one.evaluation, places)
        for one in content.compared
        if one.evaluation is not None
    ]
    made_of = [Shown(output, render_sweep(content.scene, chosen, output=output)) for output in BESIDE]
    return frames_of_page(chosen, list(kinds.values()), [predictions[0], *made_of, *predictions[1:]])
