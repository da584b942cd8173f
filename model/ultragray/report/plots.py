"""The plots of a report, as SVG that stands in the page itself."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.ticker import MaxNLocator

from ultragray.evaluation.metrics import FrameMetrics
from ultragray.evaluation.reliability import Reliability
from ultragray.evaluation.scoring import Evaluation
from ultragray.methods.comparison.plots import figure as make_figure
from ultragray.methods.comparison.plots import line_style, svg
from ultragray.methods.comparison.ranks import LABELS
from ultragray.probe import FloatArray
from ultragray.report.study import TiltStudy, Trained

COLOURS = {"scene": "#0b6e99", "median": "#d97706", "nearest": "#7c8a97", "linear": "#6d8f3c"}
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
        axis.plot(values, linewidth=1.2, color=COLOURS["scene"])
        axis.set(xlabel="training frame", ylabel=label)
    return svg(figure)


def plot_reliability(reliability: Reliability) -> str:
    """Actual over expected deviation of pixels, in bins of the expected one; beside them the line where both agree."""
    figure, axes = make_figure(1, (4.4, 4.2), columns=1)
    expected, actual = ([getattr(one, name) for one in reliability.bins] for name in ("expected", "actual"))
    most = max(*expected, *actual)
    axes[0].plot([0.0, most], [0.0, most], linewidth=1.0, color=COLOURS["nearest"])
    axes[0].plot(expected, actual, marker=".", linewidth=1.2, color=COLOURS["scene"])
    axes[0].set(xlabel="expected deviation of a pixel", ylabel="actual deviation", aspect="equal")
    return svg(figure)


def plot_training(trained: Trained) -> str:
    """The loss of each step (means of neighbouring steps in a long run) and the held-out PSNR on the way."""
    figure, axes = make_figure(2, (11.0, 2.6), columns=2)
    width = max(1, len(trained.losses) // LOSS_POINTS)
    count = len(trained.losses) // width
    means = np.array(trained.losses[: count * width]).reshape(count, width).mean(axis=1)
    axes[0].plot((np.arange(count) + 1) * width, means, linewidth=1.2, color=COLOURS["scene"])
    axes[0].set(xlabel="step", ylabel="loss")
    axes[1].plot(
        list(trained.val_psnr_db), list(trained.val_psnr_db.values()), marker=".", color=COLOURS["scene"], linewidth=1.2
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
            colour = COLOURS[method]
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
        axis.plot(counts, [getattr(points[count], name) for count in counts], marker="o", color=COLOURS["scene"])
        axis.set(xlabel="Gaussians", ylabel=LABELS[name], xscale="log")
        axis.set_xticks(counts, [f"{count:,}" for count in counts])
        axis.minorticks_off()
    return svg(figure)
