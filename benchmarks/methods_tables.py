"""Compares all methods on tracked and simulated sweeps, at equal time: `make methods`.

    python benchmarks/methods_tables.py DATA_FOLDER [--only NAME ...]

Each method's fit is kept in build/methods, and each run's figures go into the JSON as soon as it is done: a killed run
goes on. The tables of docs/results.md come from it.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from registry import FIGURES, ROOT, Document
from ultragray.datasets.source import PHANTOM, load_dataset
from ultragray.files import write_whole
from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.report.tables import METRICS, by_mean_rank, rank, shown_value
from ultragray_studies.bench.report import measured
from ultragray_studies.comparison.result import Comparison
from ultragray_studies.comparison.run import ComparisonProgress, compare
from ultragray_studies.comparison.tables import COST_HEADINGS, cost_texts
from ultragray_studies.methods.method import Paces

FOLDER = ROOT / "build" / "methods"
SECONDS_PER_LINE = 15.0

log = logging.getLogger("methods")


@dataclass(frozen=True)
class Run:
    """One comparison. `source` is a folder of the data folder, or the word phantom."""

    name: str
    source: str
    settings: ComparisonSettings = field(default_factory=ComparisonSettings)


RUNS = (
    *(Run(name, name) for name in ("ultranerf_liver", "liver_convex", "spine_phantom", "nwire_phantom", PHANTOM)),
    Run(
        "ultranerf_liver, ten times the time",
        "ultranerf_liver",
        ComparisonSettings(methods=("linear", "ultranerf-mean"), times=10.0),
    ),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("data_folder", type=Path, help="folder of the data sets")
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", choices=[run.name for run in RUNS], help="some of the runs"
    )
    parser.add_argument("--threads", type=int, default=0, help="threads of torch; 0: as many as it takes itself")
    parser.add_argument(
        "--figures", type=Path, default=FIGURES["methods_tables"].staged, help="JSON; keeps the runs it has"
    )
    parser.add_argument("--folder", type=Path, default=FOLDER, help="of the fits; a killed run goes on there")
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    if given.threads:
        torch.set_num_threads(given.threads)
    given.figures.parent.mkdir(parents=True, exist_ok=True)
    figures = json.loads(given.figures.read_text()) if given.figures.exists() else {}
    for run in RUNS:
        if given.only is None or run.name in given.only:
            figures[run.name] = measure(run, given.data_folder, given.folder)
            write_whole(given.figures, json.dumps(figures, indent=1, allow_nan=False) + "\n")


def measure(run: Run, data_folder: Path, folder: Path) -> Document:
    """The comparison of one run, from its folder of this commit where that was begun before."""
    head = measured(torch.get_num_threads())
    dataset = load_dataset(run.source if run.source == PHANTOM else data_folder / run.source)
    place = folder / str(head["commit"]) / run.name
    paces = Paces(place / "paces.json")  # not the user's, which may be of a busier hour
    comparison = compare(dataset, run.settings, folder=place, paces=paces, report=_teller(run.name))
    assert comparison is not None  # nobody tells it to stop
    return {"measured": head, **_summary(comparison, data_folder)}


def _summary(comparison: Comparison, data_folder: Path) -> Document:
    """What the tables say, without the figures of each frame and without the place of the data on this machine."""
    ranks = rank(comparison.measured)
    return {
        "train_frames": comparison.dataset.train_frames,
        "val_frames": comparison.dataset.val_frames,
        "image": f"{comparison.dataset.height}x{comparison.dataset.width}",
        "budget_s": comparison.budget_s,
        "times": comparison.times,
        "order": by_mean_rank(comparison.measured),
        "methods": {
            result.name: {
                "title": result.title,
                "failure": result.failure and result.failure.replace(f"{data_folder.resolve()}/", ""),
                "cost": dict(zip(COST_HEADINGS, cost_texts(result), strict=True)),
                "seconds": result.seconds,
                "frame_ms": result.frame_ms,
                **(
                    {}
                    if result.evaluation is None
                    else {
                        "mean": result.evaluation.mean.to_dict(),
                        "std": result.evaluation.std.to_dict(),
                        "mean_rank": ranks[result.name].mean,
                    }
                ),
            }
            for result in comparison.results
        },
    }


def _teller(name: str) -> Callable[[ComparisonProgress], None]:
    told_at = time.monotonic()

    def tell(progress: ComparisonProgress) -> None:
        nonlocal told_at
        if progress.fit is None:
            log.info("%s: %s, %d of %d", name, progress.method, progress.number, progress.of)
        elif time.monotonic() - told_at >= SECONDS_PER_LINE:
            told_at = time.monotonic()
            fit = progress.fit
            log.info("%s: %s, step %d of %d, loss %.4f", name, progress.method, fit.step, fit.steps, fit.loss)

    return tell


def tables(figures: Document) -> Iterator[str]:
    """A table of each run, best mean rank first."""
    for run in RUNS:
        if run.name in figures:
            yield from _table(run.name, figures[run.name])


def _table(name: str, run: Document) -> Iterator[str]:
    seconds = "" if run["budget_s"] is None else f", equal time {run['budget_s'] * run['times']:.0f} s"
    yield f"### {name}"
    yield ""
    yield f"{run['train_frames']} training and {run['val_frames']} held-out frames of {run['image']}{seconds}."
    yield ""
    metrics = " | ".join(metric.heading for metric in METRICS)
    yield f"| method | {' | '.join(COST_HEADINGS)} | {metrics} | mean rank |"
    yield f"|{'---|' * (len(COST_HEADINGS) + len(METRICS) + 2)}"
    methods = run["methods"]
    for key in run["order"]:
        yield _row(methods[key], [methods[other]["mean"] for other in run["order"]])
    for one in methods.values():
        if one["failure"] is not None:
            reason = one["failure"].replace("|", "/")
            yield f"| {one['title']} | failed: {reason} {'| ' * (len(COST_HEADINGS) + len(METRICS))}|"
    yield ""


def _row(one: Document, means: list[dict[str, Any]]) -> str:
    cells = []
    for metric in METRICS:
        shown = shown_value(metric.name, one["mean"][metric.name])
        best = max((mean[metric.name] for mean in means), key=lambda value, sign=metric.sign: sign * value)
        bold = "**" if shown == shown_value(metric.name, best) else ""
        cells.append(f"{bold}{shown}{bold}")
    return f"| {one['title']} | {' | '.join(one['cost'].values())} | {' | '.join(cells)} | {one['mean_rank']:.2f} |"


if __name__ == "__main__":
    main()
