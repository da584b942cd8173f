"""Plots of studies: quality over the distance to the training views, over tilt, and over the number of Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ultragray.geometry.probe import FloatArray
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation
from ultragray.learn.report.plots import COLOURS, SCENE_COLOUR, line_style, make_figure, svg
from ultragray.learn.report.tables import LABELS
from ultragray_studies.comparison.result import Distances

DISTANCE_BINS, LEAST_IN_BIN = 8, 3  # frames in fewer bins where there are not many
LEAST_TURN_DEG = 1.0  # held-out frames that differ less in their angle show nothing by it
TILT_BINS = 6
TILT_COLOURS = {"scene": SCENE_COLOUR, "median": COLOURS[0], "nearest": COLOURS[-1]}


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


def plot_tilt(angles_deg: FloatArray, evaluations: Mapping[str, Evaluation]) -> str:  # [F]
    """PSNR and GMSD over the angle to the nearest training frame: every frame, and means of equally many."""
    figure, axes = make_figure(2, (11.0, 3.0), columns=2)
    order = angles_deg.argsort()
    bins = np.array_split(order, min(TILT_BINS, len(order)))
    for axis, name in zip(axes, ("psnr_db", "gmsd"), strict=True):
        for method, evaluation in evaluations.items():
            values = np.array([getattr(frame, name) for frame in evaluation.frames])
            colour = TILT_COLOURS[method]
            axis.plot(angles_deg, values, ".", color=colour, alpha=0.25, markersize=4)
            middles = [angles_deg[part].mean() for part in bins]
            axis.plot(middles, [values[part].mean() for part in bins], color=colour, linewidth=1.6, label=method)
        axis.set(xlabel="angle to the nearest training frame, degrees", ylabel=LABELS[name])
    axes[0].legend(frameon=False, ncols=len(evaluations), loc="lower left", bbox_to_anchor=(0.0, 1.0))
    return svg(figure)


def plot_counts(points: Mapping[int, FrameMetrics]) -> str:
    """PSNR and MS-SSIM over the number of Gaussians."""
    figure, axes = make_figure(2, (11.0, 2.6), columns=2)
    counts = sorted(points)
    for axis, name in zip(axes, ("psnr_db", "ms_ssim"), strict=True):
        axis.plot(counts, [getattr(points[count], name) for count in counts], marker="o", color=SCENE_COLOUR)
        axis.set(xlabel="Gaussians", ylabel=LABELS[name], xscale="log")
        axis.set_xticks(counts, [f"{count:,}" for count in counts])
        axis.minorticks_off()
    return svg(figure)
