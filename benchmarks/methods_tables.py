"""Compares all methods on tracked and simulated sweeps, at equal time: `make methods`.

Each method's fit is kept in build/methods: a killed run goes on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from measuring import ROOT, Document, Lines, log, measure_runs, table, teller
from ultragray.datasets.source import PHANTOM, load_dataset
from ultragray.learn.evaluation.methods import ComparisonSettings
from ultragray.learn.report.tables import METRICS, by_mean_rank, rank, shown_value
from ultragray_studies.bench.report import commit
from ultragray_studies.comparison.result import Comparison
from ultragray_studies.comparison.run import ComparisonProgress, compare_methods
from ultragray_studies.comparison.tables import COST_HEADINGS, cost_texts
from ultragray_studies.methods.method import Paces
from ultragray_studies.methods.registry import chosen_methods

FOLDER = ROOT / "build" / "methods"
SOURCES = ("ultranerf_liver", "liver_convex", "spine_phantom", "nwire_phantom", PHANTOM)
RUNS = {
    **{name: (name, ComparisonSettings()) for name in SOURCES},
    "ultranerf_liver, ten times the time": (
        "ultranerf_liver",
        ComparisonSettings(methods=("linear", "ultranerf-mean"), times=10.0),
    ),
}


def measure(name: str, data_folder: Path) -> Document:
    """The comparison of one run, from its folder of this commit where that was begun before."""
    source, settings = RUNS[name]
    dataset = load_dataset(source if source == PHANTOM else data_folder / source)
    place = FOLDER / str(commit()) / name
    steps = teller(name)

    def report(progress: ComparisonProgress) -> None:
        if progress.fit is not None:
            steps(progress.fit)
        else:
            log.info("%s: %s, %d of %d", name, progress.method, progress.number, progress.of)

    paces = Paces(place / "paces.json")  # not the user's, which may be of a busier hour
    comparison = compare_methods(
        dataset, chosen_methods(settings.methods), settings, folder=place, paces=paces, report=report
    )
    assert comparison is not None  # nobody tells it to stop
    return summary(comparison, data_folder)


def summary(comparison: Comparison, data_folder: Path) -> Document:
    """What the tables say, without the figures of each frame and without the place of the data on this machine."""
    ranks = rank(comparison.measured)
    by_name = {}
    for result in comparison.results:
        by_name[result.name] = {
            "title": result.title,
            "failure": result.failure and result.failure.replace(f"{data_folder.resolve()}/", ""),
            "cost": dict(zip(COST_HEADINGS, cost_texts(result), strict=True)),
            "seconds": result.cost.seconds,
            "frame_ms": result.frame_ms,
        }
        if result.evaluation is not None:
            mean, std = result.evaluation.mean.to_dict(), result.evaluation.std.to_dict()
            by_name[result.name] |= {"mean": mean, "std": std, "mean_rank": ranks[result.name].mean}
    return {
        "train_frames": comparison.dataset.train_frames,
        "val_frames": comparison.dataset.val_frames,
        "image": f"{comparison.dataset.height}x{comparison.dataset.width}",
        "budget_s": comparison.budget_s,
        "times": comparison.times,
        "order": by_mean_rank(comparison.measured),
        "methods": by_name,
    }


def methods(figures: Document) -> Lines:
    """A table of each run, best mean rank first, then what failed."""
    for name, run in ((name, figures[name]) for name in RUNS if name in figures):
        seconds = "" if run["budget_s"] is None else f", equal time {run['budget_s'] * run['times']:.0f} s"
        yield from (f"### {name}", "")
        yield f"{run['train_frames']} training and {run['val_frames']} held-out frames of {run['image']}{seconds}."
        yield ""
        measured = [run["methods"][key] for key in run["order"]]
        failed = [one for one in run["methods"].values() if one["failure"] is not None]
        yield from table(
            ("method", *COST_HEADINGS, *(metric.heading for metric in METRICS), "mean rank"),
            (_method(one, [other["mean"] for other in measured]) for one in measured),
        )
        for one in failed:
            reason = one["failure"].replace("|", "/")
            yield f"| {one['title']} | failed: {reason} {'| ' * (len(COST_HEADINGS) + len(METRICS))}|"
        yield ""


def _method(one: Document, means: Sequence[Document]) -> Iterator[str]:
    yield from (one["title"], *one["cost"].values())
    for metric in METRICS:
        text = shown_value(metric.name, one["mean"][metric.name])
        best = max((mean[metric.name] for mean in means), key=lambda value, sign=metric.sign: sign * value)
        bold = "**" if text == shown_value(metric.name, best) else ""
        yield f"{bold}{text}{bold}"
    yield f"{one['mean_rank']:.2f}"


if __name__ == "__main__":
    measure_runs("methods_tables", __doc__, {name: partial(measure, name) for name in RUNS})
