"""Plots of what was learned: SVG that stands in a page itself, and the training curve as a picture."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ultragray.geometry.probe import FloatArray
from ultragray.learn.evaluation.scoring import Evaluation, Reliability
from ultragray.learn.report.tables import LABELS
from ultragray.learn.training.progress import Course

SCENE_COLOUR = "#0b6e99"
COLOURS = ("#d97706", "#6d8f3c", "#7c4dbe", "#c2405a", "#2a9d8f", "#8a6d3b", "#4c6ef5", "#7c8a97")
STYLES = ("-", "--", ":")  # where there are more methods than colours
LOSS_POINTS = 300  # of the curve, however long the run


def line_style(place: int) -> dict[str, Any]:
    """The look of the line of a method, by its place; the first stands out."""
    if place == 0:
        return {"color": SCENE_COLOUR, "linewidth": 2.4, "zorder": 3}
    turn, colour = divmod(place - 1, len(COLOURS))
    return {"color": COLOURS[colour], "linewidth": 1.3, "linestyle": STYLES[turn % len(STYLES)]}


def make_figure(count: int, size: tuple[float, float], *, columns: int) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=size, layout="constrained")
    grid = np.atleast_1d(figure.subplots(-(-count // columns), columns))
    axes: list[Axes] = list(grid.ravel())
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(axis="y", color="#e5e9ed", linewidth=0.8)
        axis.tick_params(labelsize=9)
    return figure, axes


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
        axis.plot(values, linewidth=1.2, color=SCENE_COLOUR)
        axis.set(xlabel="training frame", ylabel=label)
    return svg(figure)


def plot_reliability(reliability: Reliability) -> str:
    """Actual over expected deviation of pixels, in bins of the expected one; beside them the line where both agree."""
    figure, axes = make_figure(1, (4.4, 4.2), columns=1)
    expected, actual = ([getattr(one, name) for one in reliability.bins] for name in ("expected", "actual"))
    most = max(*expected, *actual)
    axes[0].plot([0.0, most], [0.0, most], linewidth=1.0, color=COLOURS[-1])
    axes[0].plot(expected, actual, marker=".", linewidth=1.2, color=SCENE_COLOUR)
    axes[0].set(xlabel="expected deviation of a pixel", ylabel="actual deviation", aspect="equal")
    return svg(figure)


def plot_training(course: Course) -> Figure:
    """The loss of each step (means of neighbouring steps in a long run) and the held-out PSNR on the way."""
    figure, axes = make_figure(2, (11.0, 2.6), columns=2)
    width = max(1, len(course.losses) // LOSS_POINTS)
    count = len(course.losses) // width
    means = np.array(course.losses[: count * width]).reshape(count, width).mean(axis=1)
    axes[0].plot((np.arange(count) + 1) * width, means, linewidth=1.2, color=SCENE_COLOUR)
    axes[0].set(xlabel="step", ylabel="loss")
    axes[1].plot(
        list(course.val_psnr_db), list(course.val_psnr_db.values()), marker=".", color=SCENE_COLOUR, linewidth=1.2
    )
    axes[1].set(xlabel="step", ylabel="held-out PSNR, dB")
    return figure


def svg(drawn: Figure) -> str:
    text = io.StringIO()
    FigureCanvasSVG(drawn)
    drawn.savefig(text, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")), transparent=True)
    written = text.getvalue()
    return written[written.index("<svg") :]


def write_training_curve(course: Course, path: Path) -> None:
    figure = plot_training(course)
    FigureCanvasAgg(figure)
    figure.savefig(path, format="png", dpi=100)
