"""Tables of what was measured on held-out frames, one row a scene or a method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple
from typing import TYPE_CHECKING

from ultragray_service.cli.output import wide_console

if TYPE_CHECKING:
    from ultragray.learn.evaluation.scoring import Evaluation
    from ultragray_studies.comparison.result import Comparison


def print_metrics(title: str, evaluations: Mapping[str, Evaluation]) -> None:
    """A table of mean ± standard deviation over the frames, one row a name."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for place, head in enumerate(("", "PSNR, dB", "MS-SSIM", "GMS", "GMSD")):
        table.add_column(head, justify="right" if place else "left", no_wrap=True)
    for name, evaluation in evaluations.items():
        mean, std = evaluation.mean, evaluation.std
        table.add_row(
            escape(name),
            f"{mean.psnr_db:.2f} ± {std.psnr_db:.2f}",
            *(f"{getattr(mean, key):.3f} ± {getattr(std, key):.3f}" for key in ("ms_ssim", "gms", "gmsd")),
        )
    console = Console()
    console.print(title, highlight=False, markup=False, soft_wrap=True)
    console.print(table)
    scales = next(iter(evaluations.values())).ms_ssim_scales
    if scales < 5:
        console.print(f"MS-SSIM over {scales} of its 5 scales, which is what the image holds", style="dim")


def print_comparison(comparison: Comparison) -> None:
    """A table of the means of each method, its costs and its mean rank, and why a method has none."""
    from rich.markup import escape
    from rich.table import Table

    from ultragray.learn.report.tables import METRICS, rank, shown_value
    from ultragray_studies.comparison.tables import budget_text, steps_text

    table = Table(box=None, pad_edge=False)
    heads = ("", *(metric.label for metric in METRICS), "steps", "training, s", "frame, ms", "MB", "mean rank")
    for place, head in enumerate(heads):
        table.add_column(head, justify="right" if place else "left", no_wrap=True)
    ranks = rank(comparison.measured)
    for one in comparison.results:
        if one.evaluation is not None:
            means = one.evaluation.mean.to_dict()
            table.add_row(
                escape(one.title),
                *(shown_value(metric.name, means[metric.name]) for metric in METRICS),
                steps_text(one),
                f"{one.seconds:,.1f}",
                f"{one.frame_ms:,.1f}",
                f"{one.model_bytes / 1e6:,.2f}",
                f"{ranks[one.name].mean:.2f}",
            )
    console, facts = wide_console(), comparison.dataset
    head = f"{facts.name}, {facts.val_frames} val frames, {comparison.machine}; budget: {budget_text(comparison)}"
    console.print(head, highlight=False, markup=False, soft_wrap=True)
    console.print(table)
    for one in comparison.results:
        if one.failure is not None:
            console.print(f"{one.title} failed: {one.failure}", highlight=False, markup=False, soft_wrap=True)


def print_speckle(evaluations: Mapping[str, Evaluation]) -> None:
    """A table of the statistics of speckle, means over the frames: the true frames, then one row a name."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for place, head in enumerate(("speckle", "contrast", "axial, mm", "lateral, mm", "histogram distance")):
        table.add_column(head, justify="right" if place else "left", no_wrap=True)
    summaries = {name: evaluation.speckle for name, evaluation in evaluations.items()}
    true = next(iter(summaries.values())).true
    rows = {
        "true frames": (true, ""),
        **{n: (one.rendered, f"{one.histogram_distance:.4f}") for n, one in summaries.items()},
    }
    for name, (speckle, distance) in rows.items():
        figures = ("–",) * 3 if speckle is None else [f"{value:.3f}" for value in astuple(speckle)]
        table.add_row(escape(name), *figures, distance)
    wide_console().print(table)
