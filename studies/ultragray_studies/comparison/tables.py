"""The tables of a comparison: rows as texts, and the same as LaTeX."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass, field

from ultragray.learn.evaluation.scoring import Evaluation
from ultragray.learn.evaluation.speckle import Speckle
from ultragray.learn.report.tables import METRICS, by_mean_rank, rank, shown_value
from ultragray_studies.comparison.result import Comparison, MethodResult
from ultragray_studies.methods.method import BudgetKind

COST_HEADINGS = ("steps", "training", "ms a frame", "MB")


@dataclass(frozen=True)
class Row:
    """A line of a table of metrics. `cells` pairs each text with whether it is the best of its column.

    A line with a `failure` has that in their place.
    """

    name: str
    cells: list[tuple[str, bool]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    failure: str | None = None
    anchor: str = ""  # of what the page says of the method


def metric_rows(evaluations: Mapping[str, Evaluation], notes: Mapping[str, list[str]] | None = None) -> list[Row]:
    """One row a method with mean ± standard deviation, the best mean of each column marked."""
    ranks = rank(evaluations)
    rows = []
    for name, evaluation in evaluations.items():
        mean, std = evaluation.mean.to_dict(), evaluation.std.to_dict()
        cells = [
            (
                f"{shown_value(metric.name, mean[metric.name])} ± {shown_value(metric.name, std[metric.name])}",
                len(evaluations) > 1 and ranks[name].by_metric[metric.name] == 1,
            )
            for metric in METRICS
        ]
        rows.append(Row(name, cells, (notes or {}).get(name, [])))
    return rows


def rank_rows(evaluations: Mapping[str, Evaluation]) -> list[Row]:
    """One row a method with its place by each metric, and the mean of them; the first of each column marked."""
    ranks = rank(evaluations)
    means = {name: f"{found.mean:.2f}" for name, found in ranks.items()}
    best = min(means.values(), key=float, default="")
    return [
        Row(name, [*((str(place), place == 1) for place in places.by_metric.values()), (mean, mean == best)])
        for (name, places), mean in zip(ranks.items(), means.values(), strict=True)
    ]


def cost_texts(result: MethodResult) -> list[str]:
    """The steps, the time, a frame and the size of a method."""
    return [
        steps_text(result),
        duration_text(result.seconds) if result.seconds > 0.0 else "–",
        f"{result.frame_ms:,.1f}" if result.frame_ms < 100.0 else f"{result.frame_ms:,.0f}",
        f"{result.model_bytes / 1e6:,.2f}" if result.model_bytes < 1e7 else f"{result.model_bytes / 1e6:,.0f}",
    ]


def steps_text(result: MethodResult) -> str:
    """Such as "1,240 of 200,000"; a dash where nothing is learned by steps."""
    if not result.steps:
        return "–"
    return f"{result.steps:,}" if result.of_steps is None else f"{result.steps:,} of {result.of_steps:,}"


def duration_text(seconds: float) -> str:
    """In the unit that reads best."""
    if seconds < 10.0:
        return f"{seconds:.1f} s"
    if seconds < 600.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 36_000.0 else f"{seconds / 3600.0:.1f} h"


def budget_text(comparison: Comparison) -> str:
    """What each method could take, in words."""
    if BudgetKind(comparison.budget) is BudgetKind.AUTHOR:
        return "the steps of each author's recipe"
    if comparison.budget_s is None:
        return "none: no method here learns within an equal time"
    times = "" if comparison.times == 1.0 else f", {comparison.times:g} times that of the scene's preset fast"
    return f"equal time, {duration_text(comparison.budget_s * comparison.times)}{times}"


def speckle_rows(evaluations: Mapping[str, Evaluation]) -> list[tuple[str, list[str]]]:
    """The statistics of speckle: the true frames, then one row a method, as texts."""
    summaries = {name: evaluation.speckle for name, evaluation in evaluations.items()}
    if not summaries:
        return []
    true = next(iter(summaries.values())).true
    return [
        ("true frames", [*_speckle_texts(true), ""]),
        *((name, [*_speckle_texts(one.rendered), f"{one.histogram_distance:.4f}"]) for name, one in summaries.items()),
    ]


def _speckle_texts(speckle: Speckle | None) -> list[str]:
    return ["–"] * 3 if speckle is None else [f"{value:.3f}" for value in astuple(speckle)]


# The table of a comparison as LaTeX, for the package booktabs.


_ESCAPES = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "%": r"\%",
    "_": r"\_",
    "&": r"\&",
    "#": r"\#",
    "$": r"\$",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "–": "--",
}


def escaped(text: str) -> str:
    """The text, as LaTeX prints it."""
    return "".join(_ESCAPES.get(character, character) for character in text)


def latex_table(comparison: Comparison) -> str:
    """A `table` environment: best mean rank first, the best of each column bold, failures at the end."""
    by_name = {one.name: one for one in comparison.results}
    order = by_mean_rank(comparison.measured)
    ranks = rank(comparison.measured)
    rows = metric_rows(
        {name: comparison.measured[name] for name in order},
        {name: [f"{ranks[name].mean:.2f}", *cost_texts(by_name[name])] for name in order},
    )
    headings = ["method", *(metric.heading for metric in METRICS), "mean rank", *COST_HEADINGS]
    lines = [
        r"% \usepackage{booktabs}",
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{escaped(_caption(comparison))}}}",
        rf"\begin{{tabular}}{{l{'r' * (len(headings) - 1)}}}",
        r"\toprule",
        _line([escaped(heading) for heading in headings]),
        r"\midrule",
        *(_row(row, by_name[row.name].title) for row in rows),
    ]
    for name, failure in comparison.failures.items():
        reason = rf"\multicolumn{{{len(headings) - 1}}}{{l}}{{failed: {escaped(failure)}}}"
        lines.append(_line([escaped(by_name[name].title), reason]))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""])


def _caption(comparison: Comparison) -> str:
    facts = comparison.dataset
    return (
        f"{facts.name}: mean ± standard deviation over {facts.val_frames} held-out frames; "
        f"budget: {budget_text(comparison)}; {comparison.machine}."
    )


def _row(row: Row, title: str) -> str:
    cells = [rf"\textbf{{{escaped(text)}}}" if best else escaped(text) for text, best in row.cells]
    return _line([escaped(title), *cells, *map(escaped, row.notes)])


def _line(cells: list[str]) -> str:
    return " & ".join(cells) + r" \\"
