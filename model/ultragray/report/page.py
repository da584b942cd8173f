"""The page of a report: one HTML file that needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import astuple, dataclass, field
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from ..datasets.sweep import Dataset, spread_places
from ..display.pixels import ByteArray, image_file
from ..evaluation.baselines import predict
from ..evaluation.compounding import VOXEL_MM
from ..evaluation.metrics import FrameMetrics
from ..evaluation.scoring import Evaluation
from ..evaluation.side_by_side import as_picture, side_by_side_panels
from ..evaluation.speckle import Speckle
from ..installation import __version__
from ..scene import GaussianScene
from .plots import LABELS, plot_counts, plot_frames, plot_tilt, plot_training
from .study import GAUSSIAN_SHARES, Failed, TiltStudy, Trained

PANEL_PIXELS, SMALL_PANEL_PIXELS = 300, 220
PLOTTED_BASELINES = ("median", "linear", "nearest")
BASELINE_NAMES = {
    "median": "median compounding",
    "mean": "mean compounding",
    "maximum": "maximum compounding",
    "linear": "linear interpolation between frames",
    "nearest": "nearest training frame",
}


@dataclass(frozen=True, eq=False)
class ReportContent:
    """Contents of a report. `trained` is None for a scene that was read from a file; a part that failed says why.

    `spread` is how many held-out frames are shown at most, from the first to the last; None: the worst, a typical one
    and the best.
    """

    dataset: Dataset
    scene: GaussianScene
    evaluation: Evaluation
    machine: str
    scene_name: str | None = None
    baselines: Mapping[str, Evaluation] = field(default_factory=dict)
    voxel_mm: float = VOXEL_MM
    spread: int | None = None
    trained: Trained | None = None
    ablations: Mapping[str, Trained | Failed] = field(default_factory=dict)
    tilt: TiltStudy | Failed | None = None


@dataclass(frozen=True)
class Row:
    """A line of a table of metrics. `cells` pairs each text with whether it is the best of its column.

    A line with a `failure` has that in their place.
    """

    name: str
    cells: list[tuple[str, bool]]
    notes: list[str]
    failure: str | None = None


def render_page(content: ReportContent) -> str:
    """The HTML text."""
    environment = Environment(
        loader=PackageLoader(__package__), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    evaluations = {"scene": content.evaluation, **content.baselines}
    shown = {name: evaluations[name] for name in ("scene", *PLOTTED_BASELINES) if name in evaluations}
    compared = {"this scene": content.evaluation}
    compared |= {BASELINE_NAMES[name]: evaluation for name, evaluation in content.baselines.items()}
    tilt = content.tilt if isinstance(content.tilt, TiltStudy) else None
    return environment.get_template("page.html").render(
        version=__version__,
        content=content,
        facts=_facts(content),
        metric_names=list(LABELS.values()),
        comparison=metric_rows(compared),
        speckle=speckle_rows(compared),
        frames_plot=plot_frames(shown),
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


def _configuration(trained: Trained | None) -> dict[str, Any]:
    """The settings of the training, without those that were not used."""
    settings = {} if trained is None else trained.scene.info.training
    return {name: value for name, value in settings.items() if value is not None}


def metric_rows(evaluations: Mapping[str, Evaluation], notes: Mapping[str, list[str]] | None = None) -> list[Row]:
    """One row a method with mean ± standard deviation, the best mean of each column marked."""
    if not evaluations:
        return []
    means = {name: evaluation.mean.to_dict() for name, evaluation in evaluations.items()}
    stds = {name: evaluation.std.to_dict() for name, evaluation in evaluations.items()}
    best = {
        metric: _text(metric, (min if metric == "gmsd" else max)(mean[metric] for mean in means.values()))
        for metric in LABELS
    }
    return [
        Row(
            name=name,
            cells=[
                (
                    f"{_text(metric, means[name][metric])} ± {_text(metric, stds[name][metric])}",
                    len(means) > 1 and _text(metric, means[name][metric]) == best[metric],
                )
                for metric in LABELS
            ],
            notes=(notes or {}).get(name, []),
        )
        for name in evaluations
    ]


def speckle_rows(evaluations: Mapping[str, Evaluation]) -> list[tuple[str, list[str]]]:
    """The statistics of speckle: the true frames, then one row a method, as texts."""
    summaries = {name: evaluation.speckle for name, evaluation in evaluations.items()}
    true = next(iter(summaries.values())).true
    return [
        ("true frames", [*_speckle_texts(true), ""]),
        *((name, [*_speckle_texts(one.rendered), f"{one.histogram_distance:.4f}"]) for name, one in summaries.items()),
    ]


def _speckle_texts(speckle: Speckle | None) -> list[str]:
    return ["–"] * 3 if speckle is None else [f"{value:.3f}" for value in astuple(speckle)]


def _text(metric: str, value: float) -> str:
    return f"{value:.2f}" if metric == "psnr_db" else f"{value:.3f}"


def _facts(content: ReportContent) -> dict[str, str]:
    dataset, scene = content.dataset, content.scene
    axial_mm, lateral_mm = dataset.train.pixel_mm
    facts = {
        **({} if content.scene_name is None else {"Scene": content.scene_name}),
        "Training frames": f"{len(dataset.train)}",
        "Held-out frames": f"{len(dataset.val)}",
        "Image": f"{dataset.train.height} rows x {dataset.train.width} scan lines",
        "Pixel": f"{axial_mm:.2f} mm axial, {lateral_mm:.2f} mm lateral in the middle",
        "Probe": str(dataset.probe),
        "Gaussians": f"{scene.gaussian_count:,}, spherical harmonics of degree {scene.sh_degree}",
        "Intensity": scene.info.intensity,
    }
    if content.trained is not None:
        facts["Training"] = (
            f"{content.trained.scene.info.training['steps']:,} steps in {content.trained.seconds:.0f} s, "
            f"{1000.0 * content.trained.step_s:.0f} ms a step"
        )
    return {**facts, "Machine": content.machine}


def _ablation_rows(content: ReportContent) -> list[Row]:
    if not content.ablations:
        return []
    runs = {**({} if content.trained is None else {"full model": content.trained}), **content.ablations}
    trained = {name: run for name, run in runs.items() if isinstance(run, Trained)}
    measured = metric_rows(
        {name: run.evaluation for name, run in trained.items()},
        {name: [f"{run.scene.gaussian_count:,}", f"{1000.0 * run.step_s:.0f}"] for name, run in trained.items()},
    )
    failed = [Row(name, [], [], run.reason) for name, run in runs.items() if isinstance(run, Failed)]
    return sorted([*measured, *failed], key=lambda row: list(runs).index(row.name))


def _counts_plot(content: ReportContent) -> str | None:
    """Over the runs that differ in their number of Gaussians only."""
    runs = [*(content.ablations.get(name) for name in GAUSSIAN_SHARES), content.trained]
    points: dict[int, FrameMetrics] = {
        run.scene.gaussian_count: run.evaluation.mean for run in runs if isinstance(run, Trained)
    }
    return plot_counts(points) if len(points) > 1 else None


def _pictures(content: ReportContent) -> list[dict[str, Any]]:
    """The chosen held-out frames, panel by panel."""
    if content.spread is None:
        places, pixels = _typical_places(content), PANEL_PIXELS
    else:
        spread = spread_places(len(content.dataset.val), content.spread)
        places, pixels = dict.fromkeys(spread.tolist(), ""), SMALL_PANEL_PIXELS
    chosen = content.dataset.val.select(list(places))
    panels = side_by_side_panels(content.scene, chosen)
    if content.baselines:
        compounded = predict(content.dataset.train, chosen.poses, "median", voxel_mm=content.voxel_mm)
        panels = {**panels, BASELINE_NAMES["median"]: compounded}
    return [
        {
            "kind": kind,
            "frame": int(chosen.frame_numbers[row]),
            "psnr": f"{content.evaluation.frames[place].psnr_db:.2f}",
            "panels": {title: _data_uri(as_picture(frames[row], chosen, pixels)) for title, frames in panels.items()},
        }
        for row, (place, kind) in enumerate(places.items())
    ]


def _typical_places(content: ReportContent) -> dict[int, str]:
    """The held-out frames where the scene does worst, as usual, and best; perhaps fewer than three."""
    order = np.argsort([-frame.psnr_db for frame in content.evaluation.frames], kind="stable")
    return {int(order[-1]): ", worst", int(order[len(order) // 2]): ", typical", int(order[0]): ", best"}


def _data_uri(picture: ByteArray) -> str:
    return "data:image/png;base64," + base64.b64encode(image_file(picture, ".png").tobytes()).decode()
