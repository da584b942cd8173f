"""Every file of measured figures: where it is kept, which target measures it, which sources it measures.

A target measures into STAGE, which git ignores; `record.py` brings what it left there to `Figures.path`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
STAGE = ROOT / "build" / "bench"

Document = dict[str, Any]


@dataclass(frozen=True)
class Figures:
    """One file. `measures` are git's pathspecs, from the root of the checkout."""

    path: str
    target: str
    measures: tuple[str, ...]

    @property
    def kept(self) -> Path:
        """The file that is under version control."""
        return ROOT / self.path

    @property
    def staged(self) -> Path:
        """The file as the target leaves it."""
        return STAGE / self.kept.name


_BENCH = "studies/ultragray_studies/bench"
_KERNEL = (
    "CMakeLists.txt",
    "model/kernels",
    "model/ultragray/rendering/backends",
    ":(exclude)model/ultragray/rendering/backends/cuda",
    "model/ultragray/rendering/frames.py",
    f"{_BENCH}/kernel.py",
)
_SERVED = (
    *_KERNEL,
    "model/ultragray/rendering/display.py",
    "workers/ultragray_workers/pool",
    *(f"service/ultragray_service/{part}" for part in ("core", "http", "rpc", "listening", "server.py")),
    f"{_BENCH}/served.py",
)
_TRAINED = (
    *_KERNEL,
    "model/ultragray/datasets",
    "model/ultragray/learn/evaluation",
    "model/ultragray/geometry/probe.py",
    "model/ultragray/learn/training",
)
_JOBS = ("workers/ultragray_workers/jobs", "workers/ultragray_workers/claims.py")
_GPU = ("model/ultragray/rendering/backends/cuda", "model/ultragray/rendering/frames.py", f"{_BENCH}/cuda.py")
_PRODUCT = ("model", "workers", "service", "proto", "client", "ros")

_FILES = (
    Figures("benchmarks/results.json", "bench", (*_SERVED, f"{_BENCH}/served.py")),
    Figures("benchmarks/kernel.json", "bench", (*_KERNEL, f"{_BENCH}/parts.py")),
    Figures("benchmarks/training.json", "bench", (*_KERNEL, "model/ultragray/learn/training", f"{_BENCH}/parts.py")),
    Figures("benchmarks/jobs.json", "bench", (*_SERVED, *_JOBS, f"{_BENCH}/clients.py")),
    Figures(
        "benchmarks/clients.json",
        "bench",
        (*_SERVED, *_JOBS, "service/ultragray_service/igtl", "client/ultragray_client", f"{_BENCH}/clients.py"),
    ),
    Figures("benchmarks/console.json", "bench-console", (*_SERVED, "web", "tests/console/measure.mjs")),
    Figures("benchmarks/cuda.json", "bench-cuda", _GPU),
    Figures("benchmarks/cuda_training.json", "bench-cuda", (*_GPU, "model/ultragray/learn/training")),
    Figures(
        "benchmarks/results_tables.json",
        "results",
        (*_TRAINED, "benchmarks/results_tables.py", "benchmarks/in_silico.py"),
    ),
    Figures(
        "benchmarks/methods_tables.json",
        "methods",
        (*_TRAINED, "studies/ultragray_studies", "benchmarks/methods_tables.py"),
    ),
    Figures("benchmarks/ablations.json", "ablations", (*_TRAINED, "benchmarks/ablations.py")),
    Figures("benchmarks/poses.json", "poses", (*_TRAINED, "benchmarks/poses.py")),
    Figures(
        "benchmarks/localization.json",
        "localization",
        (*_KERNEL, "model/ultragray/learn/localization", "benchmarks/localization.py"),
    ),
    Figures(
        "benchmarks/confidence.json",
        "confidence",
        (*_TRAINED, "model/ultragray/scene/confidence.py", "benchmarks/confidence.py", "benchmarks/in_silico.py"),
    ),
    Figures(
        "benchmarks/libraries.json",
        "libraries",
        (
            "model/ultragray/rendering/display.py",
            "model/ultragray/learn/evaluation/metrics.py",
            "model/ultragray/datasets/images.py",
            "model/ultragray/learn/training/geometry.py",
            "benchmarks/libraries.py",
        ),
    ),
    Figures(
        "benchmarks/environment.json",
        "environment",
        (
            *_KERNEL,
            "model/ultragray/rendering/contact.py",
            "studies/ultragray_studies/gym",
            "benchmarks/environment.py",
        ),
    ),
    Figures("benchmarks/ros.json", "ros", (*_SERVED, "client/ultragray_client", "ros", "benchmarks/ros.py")),
    Figures(
        "benchmarks/simulation.json",
        "simulation",
        (
            "benchmarks/scaling",
            ":(exclude)benchmarks/scaling/defaults.py",
            ":(exclude)benchmarks/scaling/picture.py",
            ":(exclude)benchmarks/scaling/tables.py",
            "benchmarks/simulation.py",
        ),
    ),
    Figures(
        "benchmarks/shards.json",
        "test-shards",
        (*_KERNEL, *_JOBS, "model/ultragray/exchange/shards.py", "workers/ultragray_workers/batches", "tests/batches"),
    ),
    Figures("tests/long-run.json", "test-long", (*_PRODUCT, "tests", ":(exclude)tests/*-run.json")),
    Figures("tests/soak-run.json", "test-soak", (*_PRODUCT, "tests/soak")),
    Figures("tests/replicas-run.json", "test-replicas", (*_PRODUCT, "docker/envoy", "tests/replicas")),
    Figures("tests/overload-run.json", "test-overload", (*_PRODUCT, "tests/overload")),
)
FIGURES = {file.kept.stem: file for file in _FILES}


def heads(document: Document) -> Iterator[Document]:
    """The heads of a file: its one, or one of each run in files that are measured run by run."""
    if "measured" in document:
        yield document["measured"]
        return
    for part in document.values():
        yield from heads(part)


def described(heads: Iterator[Document]) -> str:
    """Commits, dates and machines in words, each combination once."""
    return "; ".join(
        sorted({f"commit {head['commit']}, {head['date'][:10]}, {in_words(head['machine'])}" for head in heads})
    )


def in_words(machine: Document) -> str:
    """A machine; figures of earlier commits do not say everything about theirs."""
    model, memory = machine.get("model"), machine.get("memory_gib")
    threads, cores = machine.get("threads"), machine.get("cores")
    of_cores = "" if cores is None else f"{cores} cores"
    parts = (
        f"{machine['processor']} ({model})" if model else machine["processor"],
        machine.get("instruction_set"),
        " on ".join(part for part in (f"{threads} thread{'s'[: threads != 1]}" if threads else "", of_cores) if part),
        f"{memory:.0f} GiB" if memory else None,
    )
    return ", ".join(part for part in parts if part)
