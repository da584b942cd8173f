"""The picture of docs/scaling.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from .cases import EXPONENTS, POLICIES

COLOURS = ("#475569", "#d97706", "#c2410c", "#0b6e99", "#6d8f3c")


def draw(document: dict[str, Any], path: Path) -> None:
    """Hits and unanswered poses of the policies, and the wait by load."""
    figure = Figure(figsize=(10.5, 3.4), layout="constrained")
    hits, unanswered, waits = figure.subplots(1, 3)
    exponents, load = document["studies"]["exponents"], document["studies"]["load"]
    _by_exponent(hits, exponents, "hits", "scene in memory, % of requests")
    _by_exponent(unanswered, exponents, "unanswered", "unanswered poses, %")
    unanswered.set_yscale("log")
    hits.legend(frameon=False, fontsize="x-small", loc="lower right")
    small = [found for name, found in load.items() if "fast" not in name]
    busy = [100.0 * found["busy"][0] for found in small]
    waits.plot(busy, [found["wait_ms"][0] for found in small], ".-", color=COLOURS[3], label="mean wait, ms")
    lost = [100.0 * found["unanswered"][0] for found in small]
    waits.plot(busy, lost, ".-", color=COLOURS[2], label="unanswered poses, %")
    waits.set(xlabel="replicas busy, %", ylim=(0.0, None))
    waits.legend(frameon=False, fontsize="small")
    for axes in (hits, unanswered, waits):
        axes.spines[["top", "right"]].set_visible(False)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=90)


def _by_exponent(axes: Axes, rows: dict[str, Any], figure: str, label: str) -> None:
    for policy, colour in zip(POLICIES, COLOURS, strict=True):
        found = [rows[f"{policy}; {exponent}"][figure] for exponent in EXPONENTS]
        means, halves = ([100.0 * one[part] for one in found] for part in range(2))
        axes.errorbar(EXPONENTS, means, halves, fmt=".-", color=colour, label=policy, capsize=2)
    axes.set(xlabel="exponent of Zipf's law", ylabel=label, xticks=EXPONENTS)
