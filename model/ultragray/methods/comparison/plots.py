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

from ultragray.evaluation.scoring import Evaluation
from ultragray.methods.comparison.result import Distances
from ultragray.probe import FloatArray

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
    drawn, axes = figure(len(shown), (11.0, 4.4), columns=len(shown))
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


def figure(count: int, size: tuple[float, float], *, columns: int) -> tuple[Figure, list[Axes]]:
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
