"""The table of a comparison as LaTeX, for the package booktabs."""

from __future__ import annotations

from ultragray.methods.comparison.ranks import METRICS, by_mean_rank, rank
from ultragray.methods.comparison.result import Comparison
from ultragray.methods.comparison.tables import COST_HEADINGS, Row, budget_text, cost_texts, metric_rows

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
