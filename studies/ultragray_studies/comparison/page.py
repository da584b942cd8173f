"""The page of a comparison: one HTML file that needs nothing else."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ultragray.files import write_whole
from ultragray.learn.evaluation.scoring import Evaluation
from ultragray.learn.report.page import FrameOfPage, Shown, environment, frames_of_page, telling_places
from ultragray.learn.report.tables import Row, by_mean_rank, metric_rows, rank, rank_rows, speckle_rows
from ultragray.learn.sweep import Dataset
from ultragray_studies.comparison.place import frames_of
from ultragray_studies.comparison.plots import plot_distances
from ultragray_studies.comparison.result import RESULT_FILE, Comparison, MethodResult
from ultragray_studies.comparison.tables import (
    budget_text,
    cost_texts,
    latex_table,
    steps_text,
)
from ultragray_studies.methods.gaussians import SceneMethod
from ultragray_studies.methods.method import Description


@dataclass(frozen=True)
class _Method:
    """A method in words."""

    name: str
    title: str
    anchor: str
    description: Description
    short: str | None  # by how much it is


def render_comparison(comparison: Comparison, dataset: Dataset, folder: Path) -> str:
    """The HTML text; `folder` is that of the comparison, with the frames of each method."""
    titles = _titles(comparison)
    by_title = {titles[one.name]: one for one in comparison.results}
    evaluations = {titles[name]: comparison.measured[name] for name in by_mean_rank(comparison.measured)}
    return (
        environment("ultragray_studies")
        .get_template("comparison.html")
        .render(
            comparison=comparison,
            facts=_facts(comparison),
            rows=_rows(evaluations, by_title),
            ranks=_with_anchors(rank_rows(evaluations), by_title),
            speckle=speckle_rows(evaluations),
            pictures=_pictures(evaluations, by_title, dataset, folder),
            distance_plot=plot_distances(_scene_first(evaluations, titles), comparison.distances)
            if evaluations
            else None,
            methods=[
                _Method(one.name, title, _anchor(one), one.description, _short_text(one))
                for title, one in by_title.items()
            ],
            shortened=any(one.is_short for one in comparison.results),
            scales=min((found.ms_ssim_scales for found in evaluations.values()), default=5),
        )
    )


def _titles(comparison: Comparison) -> dict[str, str]:
    """By name; methods of the same title are told apart by their names."""
    counts = Counter(one.title for one in comparison.results)
    return {
        one.name: one.title if counts[one.title] == 1 else f"{one.title} ({one.name})" for one in comparison.results
    }


def _anchor(result: MethodResult) -> str:
    return f"method-{result.name}"


def _with_anchors(rows: list[Row], by_title: dict[str, MethodResult]) -> list[Row]:
    return [replace(row, anchor=_anchor(by_title[row.name])) for row in rows]


def _rows(evaluations: dict[str, Evaluation], by_title: dict[str, MethodResult]) -> list[Row]:
    """Those that were measured, then those that failed."""
    ranks = rank(evaluations)
    notes = {title: [f"{ranks[title].mean:.2f}", *cost_texts(by_title[title])] for title in evaluations}
    failed = [Row(title, failure=one.failure) for title, one in by_title.items() if one.failure is not None]
    return _with_anchors([*metric_rows(evaluations, notes), *failed], by_title)


def _pictures(
    evaluations: dict[str, Evaluation], by_title: dict[str, MethodResult], dataset: Dataset, folder: Path
) -> list[FrameOfPage]:
    """The frames that tell most of the scene, or of the best method where the scene was not measured."""
    if not evaluations:
        return []
    best = next(iter(evaluations))
    telling = next((title for title in evaluations if by_title[title].name == SceneMethod.name), best)
    places = telling_places(evaluations[telling])
    shown = [
        Shown.prediction(title, frames_of(folder, by_title[title].name), evaluation, list(places))
        for title, evaluation in evaluations.items()
    ]
    return frames_of_page(dataset.val.select(list(places)), list(places.values()), shown)


def _scene_first(evaluations: dict[str, Evaluation], titles: dict[str, str]) -> dict[str, Evaluation]:
    scene = titles.get(SceneMethod.name)
    return {title: evaluations[title] for title in sorted(evaluations, key=lambda title: title != scene)}


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
    if not result.is_short or result.of_steps is None:
        return None
    return f"Short: {steps_text(result)} steps of its author's recipe ({100.0 * result.steps / result.of_steps:.2g} %)."


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
