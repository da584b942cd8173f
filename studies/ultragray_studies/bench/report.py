"""The parts that benchmarks share: the head of a file of figures, the yard, the table that is printed, the JSON.

The head says which commit, date and machine the figures belong to: one without it cannot be compared with another.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

import ultragray
from ultragray.files import write_whole
from ultragray.installation import memory_bytes, processor_maker, processor_model, processor_name
from ultragray.rendering.backends import cpu
from ultragray_studies.bench.kernel import time_yard_ms

ROOT = Path(__file__).resolve().parents[3]  # of the checkout, where this is one
DIRTY = "-dirty"
_COMMIT_CHARACTERS = 12
_WRITTEN_BY_RECORDING = (
    "benchmarks/*.json",
    "tests/*-run.json",
    "README.md",
    "docs/*.md",
    "docs/images/*_reliability.png",
)


def measured(threads: int) -> dict[str, Any]:
    """The head, taken now; `threads` are those of what is measured."""
    return {
        "commit": commit(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "machine": {
            "maker": processor_maker(),
            "processor": processor_name(),
            "model": processor_model(),
            "instruction_set": cpu.INSTRUCTION_SETS[0],
            "threads": threads,
            "cores": os.cpu_count(),
            "memory_gib": round(memory_bytes() / 2**30, 1),
        },
    }


def main() -> None:
    """Print the head for what other programs measure, on all cores."""
    sys.stdout.write(json.dumps(measured(os.cpu_count() or 1)) + "\n")


def commit() -> str | None:
    """The commit of the checkout, with -dirty where its sources have changed since; None where this is no checkout."""
    if not _is_checkout():
        return None
    head = _git("rev-parse", f"--short={_COMMIT_CHARACTERS}", "HEAD")
    return head + DIRTY if head and changed_sources() else head


def changed_sources() -> list[str]:
    """Files of the checkout that differ from its commit, new ones too; not the figures and documents that recording
    writes."""
    spared = [f":(exclude){pattern}" for pattern in _WRITTEN_BY_RECORDING]
    status = _git("status", "--porcelain", "--untracked-files=all", "--no-renames", "--", ".", *spared)
    return [line[3:] for line in (status or "").splitlines()]


def _is_checkout() -> bool:
    """Whether the sources are a checkout of their own, and not installed below somebody else's."""
    top = _git("rev-parse", "--show-toplevel")
    return top is not None and Path(top).resolve() == ROOT


def _git(*words: str) -> str | None:
    """What a git command prints; None where there is no git, or it refuses."""
    command = ["git", "--no-optional-locks", "-C", str(ROOT), *words]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.rstrip()
    except (OSError, subprocess.CalledProcessError):
        return None


if __name__ == "__main__":
    main()


# The parts that benchmarks share: the machine and the yard, percentiles, the table that is printed, the JSON.


TABLE_WIDTH = 110  # columns, where no terminal says


class Report:
    """One benchmark on its way: says what is measured, then prints the table and writes the JSON."""

    def __init__(self, output: Path | None, quick: bool) -> None:
        console = Console()
        self._console = console if console.is_terminal else Console(width=TABLE_WIDTH)
        self._output = output
        self._quick = quick
        self._head = measured(torch.get_num_threads())  # now: a commit may be made while it is measured
        self._yards_ms: list[float] = []

    def tell(self, what: str) -> None:
        """Say what is measured now."""
        self._console.print(what, style="dim")

    def time_yard(self) -> float:
        """The yard, ms, as it is about now: the median of this timing and the one before."""
        self._yards_ms.append(time_yard_ms())
        return float(np.median(self._yards_ms[-2:]))

    def cpu_document(self, **figures: Any) -> dict[str, Any]:
        """A document that begins with commit, date, machine, versions and the yard."""
        head = {"measured": self._head, "versions": versions()}
        return {**head, "yard_ms": float(np.median(self._yards_ms)), **figures}

    def conclude(
        self,
        document: Mapping[str, Any],
        columns: Mapping[str, str],
        rows: Iterable[Mapping[str, Any]],
        notes: Iterable[str] = (),
    ) -> None:
        """Print the figures as a table with notes below; write the document where a file was asked for.

        A column is its head and the format string of a row's figures, such as `{p50_ms:.2f}`.
        """
        table = Table(title=_title(document))
        for number, name in enumerate(columns):
            table.add_column(name, justify="right" if number else "left")
        for row in rows:
            table.add_row(*(cell(pattern, row) for pattern in columns.values()))
        self._console.print(table)
        for note in notes:
            self._console.print(note)
        if self._output is not None:
            quick = {"quick": True} if self._quick else {}  # too few repetitions to be recorded
            write_whole(self._output, json.dumps({**document, **quick}, indent=1) + "\n")
            self._console.print(f"written to {self._output}")


def cell(pattern: str, row: Mapping[str, Any]) -> str:
    """The figures of a row in a format string; empty where one is None."""
    try:
        return pattern.format_map(row)
    except TypeError:
        return ""


def percentiles(times_ms: Sequence[float], *wanted: float) -> list[float]:
    """Percentiles of some times, ms."""
    return [float(one) for one in np.percentile(times_ms, wanted)]


def versions() -> dict[str, str]:
    """Versions of the system, of what is measured and what measures."""
    return {
        "system": platform.platform(),
        "python": platform.python_version(),
        "ultragray": ultragray.__version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "grpc": grpc.__version__,
        "uvicorn": version("uvicorn"),
    }


def _title(document: Mapping[str, Any]) -> str:
    machine = document["measured"]["machine"]
    if (gpu := document.get("gpu")) is not None:
        return (
            f"{gpu.get('name', machine['processor'])}, {gpu['renderer']}; driver {gpu.get('driver')}, "
            f"CUDA {gpu['cuda']}, torch {document['versions']['torch']}, triton {gpu['triton']}"
        )
    return (
        f"{machine['processor']}, {machine['threads']} threads, {machine['instruction_set']}; "
        f"yard {document['yard_ms']:.1f} ms"
    )
