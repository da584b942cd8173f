"""Two checkouts side by side: the latency of frames through the front doors of both services, measured in turn.

    .venv/bin/python benchmarks/paired.py ../before . --rounds 10

Both services run at the same time on one scene, of 90,000 Gaussians at 512x512; the idle one waits. Each round measures
both, in alternating order, so that drift of the machine meets both alike. Each checkout needs its own `.venv`.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import tempfile
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console
from rich.table import Table

from ultragray.installation import processor_name
from ultragray_studies.bench.kernel import BenchScene, bench_poses
from ultragray_studies.bench.served import DOORS, SCENE, WARM_UP, running_server

MEASURED = ("gRPC stream", "HTTP raw")


def main() -> None:
    """Print the median of each round's p50, in ms, of both checkouts by front door, and the ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base", type=Path, help="the checkout to compare with")
    parser.add_argument("this", type=Path, help="the checkout that is compared")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--frames", type=int, default=200, help="of a round, at each front door")
    parser.add_argument("--gaussians", type=int, default=90_000)
    parser.add_argument("--output", type=Path, help="also write the figures as JSON")
    arguments = parser.parse_args()
    checkouts, poses = [arguments.base, arguments.this], bench_poses(arguments.frames + WARM_UP)
    p50_ms: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in MEASURED}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ultragray-paired-")))
        BenchScene(arguments.gaussians, 0.05).scene.save(folder / f"{SCENE}.ugr")
        pythons = [str(checkout.absolute() / ".venv/bin/python") for checkout in checkouts]
        servers = [stack.enter_context(running_server(folder, "cpu", SCENE, python=python)) for python in pythons]
        for number in range(arguments.rounds):
            for place in (0, 1) if number % 2 == 0 else (1, 0):
                for name, pair in p50_ms.items():
                    pair[place].append(statistics.median(DOORS[name](servers[place], poses).latency_ms))
    commits = [_commit(checkout) for checkout in checkouts]
    doors = {name: _compared(*pair) for name, pair in p50_ms.items()}
    table = Table("", *commits, "ratio", title=f"{processor_name()}: p50 in ms, medians of {arguments.rounds} rounds")
    for name, compared in doors.items():
        table.add_row(name, *(f"{figure:.3f}" for figure in compared.values()))
    Console().print(table)
    if arguments.output is not None:
        document = {"processor": processor_name(), "base": commits[0], "this": commits[1], "doors": doors}
        arguments.output.write_text(json.dumps(document, indent=1) + "\n")


def _compared(base_ms: list[float], this_ms: list[float]) -> dict[str, float]:
    """Medians over the rounds; the ratio is the median of the rounds' ratios."""
    ratios = [this / base for base, this in zip(base_ms, this_ms, strict=True)]
    medians = {"base_ms": statistics.median(base_ms), "this_ms": statistics.median(this_ms)}
    return medians | {"ratio": statistics.median(ratios)}


def _commit(checkout: Path) -> str:
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()
