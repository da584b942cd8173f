"""The tables of a comparison: rows as texts, and the same as LaTeX."""

from __future__ import annotations

from ultragray.learn.evaluation.methods import BudgetKind
from ultragray.learn.report.tables import METRICS, Row, by_mean_rank, metric_rows, rank
from ultragray_studies.comparison.result import Comparison, MethodResult

COST_HEADINGS = ("steps", "training", "ms a frame", "MB")


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
