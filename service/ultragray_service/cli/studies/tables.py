"""Tables of what was measured on held-out frames, one row a scene or a method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ultragray.evaluation.scoring import Evaluation


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


def print_speckle(evaluations: Mapping[str, Evaluation]) -> None:
    """A table of the statistics of speckle, means over the frames: the true frames, then one row a name."""
    from rich.console import Console
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
    Console().print(table)
