"""The page of a comparison, with its plots: one HTML file that needs nothing else; and the files beside it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ultragray.files import write_whole
from ultragray.geometry.probe import FloatArray
from ultragray.learn.evaluation.metrics import FrameMetrics
from ultragray.learn.evaluation.scoring import Evaluation
from ultragray.learn.report.page import FrameOfPage, Shown, environment, frames_of_page, telling_places
from ultragray.learn.report.plots import COLOURS, SCENE_COLOUR, line_style, make_figure, svg
from ultragray.learn.report.tables import LABELS, Row, by_mean_rank, metric_rows, rank, rank_rows, speckle_rows
from ultragray.learn.sweep import Dataset, Distances
from ultragray_studies.comparison.result import RESULT_FILE, Comparison, MethodResult
from ultragray_studies.comparison.run import frames_of
from ultragray_studies.comparison.tables import (
    PATH_HEADING,
    budget_text,
    cost_texts,
    latex_table,
    path_texts,
    steps_text,
)
from ultragray_studies.methods.gaussians import SceneMethod

DISTANCE_BINS, LEAST_IN_BIN = 8, 3  # frames in fewer bins where there are not many
LEAST_TURN_DEG = 1.0  # held-out frames that differ less in their angle show nothing by it
TILT_BINS = 6
TILT_COLOURS = {"scene": SCENE_COLOUR, "median": COLOURS[0], "nearest": COLOURS[-1]}


def binned_medians(distances: FloatArray, values: FloatArray) -> FloatArray:  # [F] both -> [2, B]
    """Medians of both in at most DISTANCE_BINS bins of about equally many frames; those equally far are in one bin."""
    count = max(1, min(DISTANCE_BINS, len(distances) // LEAST_IN_BIN))
    edges = np.unique(np.quantile(distances, np.linspace(0.0, 1.0, count + 1)).round(9))
    bins = np.searchsorted(edges[1:-1], distances.round(9), side="right")
    filled = [bins == number for number in np.unique(bins)]
    return np.array([[np.median(of[inside]) for inside in filled] for of in (distances, values)])


def plot_distances(evaluations: Mapping[str, Evaluation], distances: Distances) -> str:
    """PSNR over the distance to the nearest training view, one line a method; and over the angle where that varies.

    The first method is drawn as the scene.
    """
    panels = {"distance to the nearest training view, mm": distances.mm}
    if np.ptp(distances.deg) > LEAST_TURN_DEG:
        panels["angle to it, degrees"] = distances.deg
    drawn, axes = make_figure(len(panels), (11.0, 4.4), columns=len(panels))
    for axis, (label, away) in zip(axes, panels.items(), strict=True):
        for place, (name, evaluation) in enumerate(evaluations.items()):
            psnr_db = np.array([frame.psnr_db for frame in evaluation.frames])
            axis.plot(*binned_medians(away, psnr_db), marker="o", markersize=3.5, label=name, **line_style(place))
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


# The page of a comparison: one HTML file that needs nothing else.


def render_comparison(comparison: Comparison, dataset: Dataset, folder: Path) -> str:
    """The HTML text; `folder` is that of the comparison, with the frames of each method."""
    counts = Counter(one.title for one in comparison.results)
    by_title = {  # methods of the same title are told apart by their names
        one.title if counts[one.title] == 1 else f"{one.title} ({one.name})": one for one in comparison.results
    }
    titles = {one.name: title for title, one in by_title.items()}
    evaluations = {titles[name]: comparison.measured[name] for name in by_mean_rank(comparison.measured)}
    scene, ranks = titles.get(SceneMethod.name), rank(evaluations)
    scene_first = {title: evaluations[title] for title in sorted(evaluations, key=lambda title: title != scene)}
    notes = {
        title: [*path_texts(comparison, by_title[title]), f"{ranks[title].mean:.2f}", *cost_texts(by_title[title])]
        for title in evaluations
    }
    failed = [Row(title, failure=one.failure) for title, one in by_title.items() if one.failure is not None]

    def with_anchors(rows: list[Row]) -> list[Row]:
        return [replace(row, anchor=f"method-{by_title[row.name].name}") for row in rows]

    values = {
        "comparison": comparison,
        "path_headings": [PATH_HEADING] if comparison.has_path else [],
        "facts": _facts(comparison),
        "rows": with_anchors([*metric_rows(evaluations, notes), *failed]),
        "ranks": with_anchors(rank_rows(evaluations)),
        "speckle": speckle_rows(evaluations),
        "pictures": _pictures(evaluations, scene, by_title, dataset, folder),
        "distance_plot": plot_distances(scene_first, comparison.distances) if evaluations else None,
        "methods": [{"title": title, "row": one, "short": _short_text(one)} for title, one in by_title.items()],
        "shortened": any(one.cost.is_short for one in comparison.results),
        "scales": min((evaluation.ms_ssim_scales for evaluation in evaluations.values()), default=5),
    }
    return environment("ultragray_studies").get_template("comparison.html").render(values)


def _pictures(
    evaluations: dict[str, Evaluation],
    scene: str | None,
    by_title: dict[str, MethodResult],
    dataset: Dataset,
    folder: Path,
) -> list[FrameOfPage]:
    """The frames that tell most of the scene, or of the best method where the scene was not measured."""
    if not evaluations:
        return []
    telling = next((title for title in evaluations if title == scene), next(iter(evaluations)))
    places = telling_places(evaluations[telling])
    columns = [
        Shown.prediction(title, frames_of(folder, by_title[title].name), evaluation, list(places))
        for title, evaluation in evaluations.items()
    ]
    return frames_of_page(dataset.val.select(list(places)), list(places.values()), columns)


def _facts(comparison: Comparison) -> dict[str, str]:
    facts, away = comparison.dataset, comparison.distances
    return {
        "Budget": budget_text(comparison),
        "Machine": comparison.machine,
        "Training frames": f"{facts.train_frames}",
        "Held-out frames": (
            f"{facts.val_frames}, {np.median(away.mm):.2f} mm and {np.median(away.deg):.2f}° from the nearest training "
            f"frame (median; at most {away.mm.max():.2f} mm, {away.deg.max():.2f}°)"
        ),
        **facts.image_words,
        "Dataset": f"SHA-256 {facts.sha256[:16]}…",
        "Seed": f"{comparison.seed}",
    }


def _short_text(result: MethodResult) -> str | None:
    cost = result.cost
    if not cost.is_short or cost.of_steps is None:
        return None
    return f"Short: {steps_text(result)} steps of its author's recipe ({100.0 * cost.steps / cost.of_steps:.2g} %)."


# The files of a comparison: what it found as JSON, as a table of LaTeX and as a page.


TABLE_FILE, PAGE_FILE = "comparison.tex", "comparison.html"


def write_comparison(comparison: Comparison, dataset: Dataset, folder: Path) -> list[Path]:
    """Writes them into the comparison's folder and returns their paths; each needs nothing else of the folder."""
    contents = {
        RESULT_FILE: json.dumps(comparison.to_dict(), indent=1) + "\n",
        TABLE_FILE: latex_table(comparison),
        PAGE_FILE: render_comparison(comparison, dataset, folder),
    }
    for name, content in contents.items():
        write_whole(folder / name, content)
    return [folder / name for name in contents]
