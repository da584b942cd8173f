"""`ultragray bench`: the kernel and the service, measured on this machine.

A benchmark is a function of a module that is imported when it is chosen.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from ultragray.errors import BackendUnavailable, InvalidArgument
from ultragray_service.cli.terminal import COMPUTE, Force, Json, check_file, command_group, examples, output_option

INSTEAD = "Instead of frames"
Bench = Callable[[Path | None, bool], None]  # the JSON file to write, and whether few repetitions do

_BENCHES = {
    ("frames", "cpu"): ("served", "bench_frames"),
    ("frames", "cuda"): ("cuda", "bench_frames"),
    ("train", "cpu"): ("parts", "bench_training"),
    ("train", "cuda"): ("cuda", "bench_training"),
    ("jobs", "cpu"): ("clients", "bench_jobs"),
    ("clients", "cpu"): ("clients", "bench_clients"),
    ("kernel-details", "cpu"): ("parts", "bench_kernel_details"),
}
BACKENDS = tuple(dict.fromkeys(backend for _, backend in _BENCHES))
command_app = command_group()


@command_app.command(epilog=examples("ultragray bench --quick", "ultragray bench --train -o train.json"))
def bench(
    output: Annotated[Path | None, output_option("Also write the figures as JSON.", default="none")] = None,
    force: Force = False,
    json: Json = False,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer repetitions: a minute instead of several.")] = False,
    train: Annotated[
        bool, typer.Option("--train", help="Measure a training step and its parts.", rich_help_panel=INSTEAD)
    ] = False,
    jobs: Annotated[
        bool,
        typer.Option(
            "--jobs", help="Measure a long list of jobs, and frames beside a training.", rich_help_panel=INSTEAD
        ),
    ] = False,
    clients: Annotated[
        bool,
        typer.Option("--clients", help="Measure what control loops, pages and scripts get.", rich_help_panel=INSTEAD),
    ] = False,
    kernel_details: Annotated[
        bool,
        typer.Option(
            "--kernel-details",
            help="Measure the parts of a frame in the kernel, and its work.",
            rich_help_panel=INSTEAD,
        ),
    ] = False,
    backend: Annotated[str, typer.Option(help="cpu, or cuda: the first GPU.", rich_help_panel=COMPUTE)] = "cpu",
) -> None:
    """Times are medians and percentiles, ms. Close other programs first: what shares the cores is measured too."""
    wanted = {"train": train, "jobs": jobs, "clients": clients, "kernel-details": kernel_details}
    chosen = [name for name, is_wanted in wanted.items() if is_wanted]
    if len(chosen) > 1:
        raise InvalidArgument("give one of --train, --jobs, --clients and --kernel-details", field=chosen[0])
    if output is not None:
        check_file(output, force=force)

    run = chosen_bench(chosen[0] if chosen else "frames", backend)
    if not json:
        run(output, quick)
        return
    with tempfile.TemporaryDirectory() as folder:
        figures = output or Path(folder, "figures.json")
        with contextlib.redirect_stdout(sys.stderr):  # the table is for people
            run(figures, quick)
        typer.echo(figures.read_text(encoding="utf-8"), nl=False)


def chosen_bench(name: str, backend: str) -> Bench:
    """The benchmark of that name on a backend.

    Raises BackendUnavailable for one that is not cpu or cuda, and for cuda where there is no GPU; InvalidArgument for
    a benchmark that the backend does not have.
    """
    if backend not in BACKENDS:
        raise BackendUnavailable(f"backend must be {' or '.join(BACKENDS)}, got {backend!r}", field="backend")
    if (place := _BENCHES.get((name, backend))) is None:
        raise InvalidArgument(f"--{name} goes without --backend", field="backend")
    if backend == "cuda":
        from ultragray.rendering.backends import cuda

        cuda.require()
    module, function = place
    bench: Bench = getattr(importlib.import_module(f".{module}", __package__), function)
    return bench
