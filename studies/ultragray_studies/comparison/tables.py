"""The tables of a comparison: rows as texts, and the same as LaTeX."""

from __future__ import annotations

from ultragray.learn.evaluation.methods import BudgetKind
from ultragray.learn.report.tables import METRICS, by_mean_rank, metric_rows, rank, shown_value
from ultragray_studies.comparison.result import Comparison, MethodResult

PATH_HEADING = "on the path, dB"
COST_HEADINGS = ("steps", "training", "ms a frame", "MB")


def path_texts(comparison: Comparison, result: MethodResult) -> list[str]:
    """The PSNR on the path that neighbours agree with: one text where the comparison has it of some method."""
    metrics = result.on_path
    return ["–" if metrics is None else shown_value("psnr_db", metrics.psnr_db)] if comparison.has_path else []


def cost_texts(result: MethodResult) -> list[str]:
    """The steps, the time, a frame and the size of a method."""
    seconds, megabytes = result.cost.seconds, result.cost.model_bytes / 1e6
    return [
        steps_text(result),
        duration_text(seconds) if seconds > 0.0 else "–",
        f"{result.frame_ms:,.{1 if result.frame_ms < 100.0 else 0}f}",
        f"{megabytes:,.{2 if megabytes < 10.0 else 0}f}",
    ]


def steps_text(result: MethodResult) -> str:
    """Such as "1,240 of 200,000"; a dash where nothing is learned by steps."""
    steps, of_steps = result.cost.steps, result.cost.of_steps
    return f"{steps:,}" + ("" if of_steps is None else f" of {of_steps:,}") if steps else "–"


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


_ESCAPES: dict[str, str | int | None] = {
    "\\": r"\textbackslash{}",
    **{character: f"\\{character}" for character in "{}%_&#$"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "–": "--",
}


def escaped(text: str) -> str:
    """The text, as LaTeX prints it."""
    return text.translate(str.maketrans(_ESCAPES))


def latex_table(comparison: Comparison) -> str:
    """A `table` environment: best mean rank first, the best of each column bold, failures at the end."""
    by_name = {one.name: one for one in comparison.results}
    ranks, facts = rank(comparison.measured), comparison.dataset
    path_heading = [PATH_HEADING] if comparison.has_path else []
    headings = ["method", *(metric.heading for metric in METRICS), *path_heading, "mean rank", *COST_HEADINGS]
    caption = (
        f"{facts.name}: mean ± standard deviation over {facts.val_frames} held-out frames; "
        f"budget: {budget_text(comparison)}; {comparison.machine}."
    )

    def line(*cells: str) -> str:
        return " & ".join(cells) + r" \\"

    lines = []
    for row in metric_rows({name: comparison.measured[name] for name in by_mean_rank(comparison.measured)}):
        one = by_name[row.name]
        cells = [rf"\textbf{{{escaped(text)}}}" if best else escaped(text) for text, best in row.cells]
        notes = [*path_texts(comparison, one), f"{ranks[row.name].mean:.2f}", *cost_texts(one)]
        lines.append(line(escaped(one.title), *cells, *map(escaped, notes)))
    for name, failure in comparison.failures.items():
        reason = rf"\multicolumn{{{len(headings) - 1}}}{{l}}{{failed: {escaped(failure)}}}"
        lines.append(line(escaped(by_name[name].title), reason))
    return "\n".join(
        (
            r"% \usepackage{booktabs}",
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{escaped(caption)}}}",
            rf"\begin{{tabular}}{{l{'r' * (len(headings) - 1)}}}",
            r"\toprule",
            line(*map(escaped, headings)),
            r"\midrule",
            *lines,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        )
    )
