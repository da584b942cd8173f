"""The plots of comparisons and reports, as SVG that stands in the page itself."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ultragray.geometry.probe import FloatArray
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation, Reliability
from ultragray.learn.report.tables import LABELS
from ultragray_studies.comparison.result import Distances
from ultragray_studies.report.study import TiltStudy, Trained

SCENE_COLOUR = "#0b6e99"
COLOURS = ("#d97706", "#6d8f3c", "#7c4dbe", "#c2405a", "#2a9d8f", "#8a6d3b", "#4c6ef5", "#7c8a97")
STYLES = ("-", "--", ":")  # where there are more methods than colours
DISTANCE_BINS, LEAST_IN_BIN = 8, 3  # frames in fewer bins where there are not many
LEAST_TURN_DEG = 1.0  # held-out frames that differ less in their angle show nothing by it


@dataclass(frozen=True)
class Binned:
    """Medians of a metric in bins of distance."""

    distances: FloatArray  # [B] the median of each bin
    medians: FloatArray  # [B]


def binned_medians(distances: FloatArray, values: FloatArray) -> Binned:  # [F] both
    """In at most DISTANCE_BINS bins of about equally many frames; frames equally far are in one bin."""
    count = max(1, min(DISTANCE_BINS, len(distances) // LEAST_IN_BIN))
    edges = np.unique(np.quantile(distances, np.linspace(0.0, 1.0, count + 1)).round(9))
    bins = np.searchsorted(edges[1:-1], distances.round(9), side="right")
    filled = [bins == number for number in np.unique(bins)]
    return Binned(
        np.array([np.median(distances[inside]) for inside in filled]),
        np.array([np.median(values[inside]) for inside in filled]),
    )


def plot_distances(evaluations: Mapping[str, Evaluation], distances: Distances) -> str:
    """PSNR over the distance to the nearest training view, one line a method; and over the angle where that varies.

    The first method is drawn as the scene.
    """
    shown = {"distance to the nearest training view, mm": distances.mm}
    if np.ptp(distances.deg) > LEAST_TURN_DEG:
        shown["angle to it, degrees"] = distances.deg
    drawn, axes = make_figure(len(shown), (11.0, 4.4), columns=len(shown))
    for axis, (label, away) in zip(axes, shown.items(), strict=True):
        for place, (name, evaluation) in enumerate(evaluations.items()):
            psnr_db = np.array([frame.psnr_db for frame in evaluation.frames])
            found = binned_medians(away, psnr_db)
            axis.plot(found.distances, found.medians, marker="o", markersize=3.5, label=name, **line_style(place))
        axis.set(xlabel=label, ylabel="PSNR, dB (median)")
    handles, labels = axes[0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside right center", frameon=False, fontsize=9)
    return svg(drawn)


def line_style(place: int) -> dict[str, Any]:
    """The look of the line of a method, by its place; the first stands out."""
    if place == 0:
        return {"color": SCENE_COLOUR, "linewidth": 2.4, "zorder": 3}
    turn, colour = divmod(place - 1, len(COLOURS))
    return {"color": COLOURS[colour], "linewidth": 1.3, "linestyle": STYLES[turn % len(STYLES)]}


def make_figure(count: int, size: tuple[float, float], *, columns: int) -> tuple[Figure, list[Axes]]:
    """A figure of so many plots, in inches."""
    made = Figure(figsize=size, layout="constrained")
    grid = np.atleast_1d(made.subplots(-(-count // columns), columns))
    axes: list[Axes] = list(grid.ravel())
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(axis="y", color="#e5e9ed", linewidth=0.8)
        axis.tick_params(labelsize=9)
    return made, axes


def svg(drawn: Figure) -> str:
    """The element `<svg>`."""
    text = io.StringIO()
    FigureCanvasSVG(drawn)
    drawn.savefig(text, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")), transparent=True)
    written = text.getvalue()
    return written[written.index("<svg") :]


# The plots of a report, as SVG that stands in the page itself.


METHOD_COLOURS = {"scene": "#0b6e99", "median": "#d97706", "nearest": "#7c8a97", "linear": "#6d8f3c"}
TILT_BINS = 6
LOSS_POINTS = 300  # of the curve, however long the run


def plot_frames(evaluations: Mapping[str, Evaluation]) -> str:
    """Each metric over the frame numbers, one line a method."""
    figure, axes = make_figure(len(LABELS), (11.0, 4.6), columns=2)
    for axis, (name, label) in zip(axes, LABELS.items(), strict=True):
        for place, (method, evaluation) in enumerate(evaluations.items()):
            order = evaluation.frame_numbers.argsort()
            values = np.array([getattr(frame, name) for frame in evaluation.frames])
            axis.xaxis.set_major_locator(MaxNLocator(integer=True))
            axis.plot(
                evaluation.frame_numbers[order],
                values[order],
                marker=".",
                markersize=4,
                label=method,
                **line_style(place),
            )
        axis.set(xlabel="frame", ylabel=label)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", frameon=False, ncols=len(evaluations))
    return svg(figure)


def plot_corrections(shift_mm: FloatArray, turn_deg: FloatArray) -> str:  # [P] both
    """How far each training frame's pose was corrected."""
    figure, axes = make_figure(2, (11.0, 2.6), columns=2)
    for axis, values, label in zip(axes, (shift_mm, turn_deg), ("shift, mm", "turn, degrees"), strict=True):
        axis.plot(values, linewidth=1.2, color=METHOD_COLOURS["scene"])
        axis.set(xlabel="training frame", ylabel=label)
    return svg(figure)


def plot_reliability(reliability: Reliability) -> str:
    """Actual over expected deviation of pixels, in bins of the expected one; beside them the line where both agree."""
    figure, axes = make_figure(1, (4.4, 4.2), columns=1)
    expected, actual = ([getattr(one, name) for one in reliability.bins] for name in ("expected", "actual"))
    most = max(*expected, *actual)
    axes[0].plot([0.0, most], [0.0, most], linewidth=1.0, color=METHOD_COLOURS["nearest"])
    axes[0].plot(expected, actual, marker=".", linewidth=1.2, color=METHOD_COLOURS["scene"])
    axes[0].set(xlabel="expected deviation of a pixel", ylabel="actual deviation", aspect="equal")
    return svg(figure)


def plot_training(trained: Trained) -> str:
    """The loss of each step (means of neighbouring steps in a long run) and the held-out PSNR on the way."""
    figure, axes = make_figure(2, (11.0, 2.6), columns=2)
    width = max(1, len(trained.losses) // LOSS_POINTS)
    count = len(trained.losses) // width
    means = np.array(trained.losses[: count * width]).reshape(count, width).mean(axis=1)
    axes[0].plot((np.arange(count) + 1) * width, means, linewidth=1.2, color=METHOD_COLOURS["scene"])
    axes[0].set(xlabel="step", ylabel="loss")
    axes[1].plot(
        list(trained.val_psnr_db),
        list(trained.val_psnr_db.values()),
        marker=".",
        color=METHOD_COLOURS["scene"],
        linewidth=1.2,
    )
    axes[1].set(xlabel="step", ylabel="held-out PSNR, dB")
    return svg(figure)


def plot_tilt(study: TiltStudy) -> str:
    """PSNR and GMSD over the angle to the nearest training frame: every frame, and means of equally many."""
    figure, axes = make_figure(2, (11.0, 3.0), columns=2)
    order = study.angles_deg.argsort()
    bins = np.array_split(order, min(TILT_BINS, len(order)))
    for axis, name in zip(axes, ("psnr_db", "gmsd"), strict=True):
        for method, evaluation in study.evaluations.items():
            values = np.array([getattr(frame, name) for frame in evaluation.frames])
            colour = METHOD_COLOURS[method]
            axis.plot(study.angles_deg, values, ".", color=colour, alpha=0.25, markersize=4)
            middles = [study.angles_deg[part].mean() for part in bins]
            axis.plot(middles, [values[part].mean() for part in bins], color=colour, linewidth=1.6, label=method)
        axis.set(xlabel="angle to the nearest training frame, degrees", ylabel=LABELS[name])
    axes[0].legend(frameon=False, ncols=len(study.evaluations), loc="lower left", bbox_to_anchor=(0.0, 1.0))
    return svg(figure)


def plot_counts(points: Mapping[int, FrameMetrics]) -> str:
    """PSNR and MS-SSIM over the number of Gaussians."""
    figure, axes = make_figure(2, (11.0, 2.6), columns=2)
    counts = sorted(points)
    for axis, name in zip(axes, ("psnr_db", "ms_ssim"), strict=True):
        axis.plot(counts, [getattr(points[count], name) for count in counts], marker="o", color=METHOD_COLOURS["scene"])
        axis.set(xlabel="Gaussians", ylabel=LABELS[name], xscale="log")
        axis.set_xticks(counts, [f"{count:,}" for count in counts])
        axis.minorticks_off()
    return svg(figure)
