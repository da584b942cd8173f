"""`ultragray bench`: what a frame costs in the kernel and through each front door, and a training step, here and now.

Machines drift, so every time is also given in yards, a fixed piece of work timed in the same run (docs/physics.md §5).
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass
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
from ultragray.backends import cpu, cuda
from ultragray.errors import BackendUnavailable, InvalidArgument
from ultragray.files.atomic import write_whole
from ultragray.machine import processor_name

from .clients import ClientsExtent, measure_clients
from .jobs import JobsExtent, measure_jobs
from .kernel import BATCH, BenchScene, bench_scenes, measure_kernel, time_yard_ms
from .served import measure_served
from .train import PARTS, measure_training, training_scenes

TABLE_WIDTH = 110  # columns, where no terminal says


@dataclass(frozen=True)
class Row:
    """One measurement; times are per frame."""

    what: str
    gaussians: int
    image: str  # H x W
    threads: int
    poses: int  # rendered together
    p50_ms: float
    p99_ms: float
    p50_yards: float
    frames_per_s: float
    above_kernel_ms: float | None = None  # p50 over that of the kernel's single pose at the same thread count


def chosen_bench(backend: str, *, train: bool, jobs: bool, clients: bool) -> Callable[[Path | None, bool], None]:
    """What measures the kernel and the service, or a training step, jobs, clients, on a backend.

    Raises BackendUnavailable for one that is not cpu or cuda, and for cuda where there is no GPU; InvalidArgument for
    choices that do not go together.
    """
    if train + jobs + clients > 1 or ((jobs or clients) and backend != "cpu"):
        raise InvalidArgument("give one of --train, --jobs and --clients; the last two go without --backend")
    if jobs:
        return run_jobs_bench
    if clients:
        return run_clients_bench
    if backend == "cpu":
        return run_training_bench if train else run_bench
    if backend != "cuda":
        raise BackendUnavailable(f"backend must be cpu or cuda, got {backend!r}", field="backend")
    cuda.require()
    from .cuda import run_cuda_bench, run_cuda_training_bench

    return run_cuda_training_bench if train else run_cuda_bench


def run_bench(output: Path | None, quick: bool) -> None:
    """Prints the table; writes it as JSON to `output`. `quick` takes few repetitions and leaves the large scene out."""
    console = bench_console()
    repeats = 20 if quick else 200
    threads = torch.get_num_threads()
    yards = [time_yard_ms()]
    rows: list[Row] = []
    memory_mb: dict[str, float] = {}
    for scene in bench_scenes(quick):
        console.print(f"{scene.gaussian_count:,} Gaussians: kernel ...", style="dim")
        timings = measure_kernel(scene, sorted({1, threads}), repeats)
        yards.append(time_yard_ms())
        yard = float(np.median(yards[-2:]))
        for timing in timings:
            rows.append(_row(scene, yard, timing.what, timing.threads, timing.poses, timing.frame_ms))
        kernel_p50 = next(row.p50_ms for row in rows[-len(timings) :] if row.threads == threads and row.poses == 1)
        console.print(f"{scene.gaussian_count:,} Gaussians: served ...", style="dim")
        served = measure_served(scene, repeats, "cpu")
        memory_mb[str(scene.gaussian_count)] = served.worker_memory_mb
        yards.append(time_yard_ms())
        yard = float(np.median(yards[-2:]))
        for front_door in served.front_doors:
            row = _row(scene, yard, front_door.what, threads, 1, front_door.latency_ms)
            rows.append(
                Row(
                    **{
                        **asdict(row),
                        "frames_per_s": front_door.frames_per_s,
                        "above_kernel_ms": row.p50_ms - kernel_p50,
                    }
                )
            )
    document = {
        "machine": _machine(threads),
        "yard_ms": float(np.median(yards)),
        "worker_memory_mb": memory_mb,
        "rows": [asdict(row) for row in rows],
    }
    _print_table(console, rows, document)
    write_document(console, output, document)


def run_training_bench(output: Path | None, quick: bool) -> None:
    """The same for a training step and its parts; `quick` takes few repetitions and leaves the large scene out."""
    console = bench_console()
    threads = torch.get_num_threads()
    rows: list[dict[str, Any]] = []
    yards: list[float] = []
    for scene in training_scenes()[1 if quick else 0 :]:
        console.print(f"{scene.gaussian_count:,} Gaussians: training ...", style="dim")
        before = time_yard_ms()
        timing = measure_training(scene, threads, repeats=5 if quick else 20)
        yards.append(float(np.median([before, time_yard_ms()])))
        step_ms = float(np.median(timing.step_ms))
        rows.append(
            {
                "gaussians": scene.gaussian_count,
                "images": f"{BATCH} of {scene.height}x{scene.width}",
                "threads": threads,
                "step_ms": step_ms,
                "step_yards": step_ms / yards[-1],
                "shares": {part: timing.share(part) for part in PARTS},
            }
        )
    document = {"machine": _machine(threads), "yard_ms": float(np.median(yards)), "rows": rows}
    table = Table(title=_title(document))
    for name in ("Gaussians", "images", "step ms", "yards", *PARTS):
        table.add_column(name, justify="right")
    for row in rows:
        shares = (f"{100.0 * row['shares'][part]:.0f} %" for part in PARTS)
        table.add_row(
            f"{row['gaussians']:,}", row["images"], f"{row['step_ms']:.0f}", f"{row['step_yards']:.1f}", *shares
        )
    console.print(table)
    write_document(console, output, document)


def run_jobs_bench(output: Path | None, quick: bool) -> None:
    """A full list of jobs, the start of a service that has one, and frames while a training runs."""
    console = bench_console()
    extent = JobsExtent(rounds=2, seconds=4.0) if quick else JobsExtent()
    yards = [time_yard_ms()]
    measured = measure_jobs(extent, lambda told: console.print(told, style="dim"))
    yards.append(time_yard_ms())
    document = {
        "machine": _machine(torch.get_num_threads()),
        "yard_ms": float(np.median(yards)),
        "extent": asdict(extent),
        **measured,
    }
    table = Table("", "p50 ms", "p99 ms", title=_title(document))
    for what, times in measured["latency_ms"].items():
        table.add_row(what, f"{times['p50']:.2f}", f"{times['p99']:.2f}")
    console.print(table)
    console.print(f"ready with {extent.jobs:,} jobs after {measured['start_s']:.2f} s")
    console.print(f"p99 of frames with a training over that without: {measured['p99_ratio']:.2f}")
    write_document(console, output, document)


def run_clients_bench(output: Path | None, quick: bool) -> None:
    """What each kind of client gets of a served demo scene."""
    console = bench_console()
    short = ClientsExtent(loop_s=5.0, stream_s=2.0, ping_pongs=100, frames=500, kernel_repeats=50)
    extent = short if quick else ClientsExtent()
    yards = [time_yard_ms()]
    measured = measure_clients(extent, lambda told: console.print(told, style="dim"))
    yards.append(time_yard_ms())
    document = {
        "machine": _machine(torch.get_num_threads()),
        "yard_ms": float(np.median(yards)),
        "extent": asdict(extent),
        "clients": measured,
    }
    table = Table("client", "figure", "", title=_title(document))
    for client, figures in measured.items():
        for name, value in figures.items():
            table.add_row(client, name, f"{value:,.2f}")
    console.print(table)
    write_document(console, output, document)


def bench_console() -> Console:
    """As wide as the terminal; elsewhere as wide as a table."""
    console = Console()
    return console if console.is_terminal else Console(width=TABLE_WIDTH)


def write_document(console: Console, output: Path | None, document: dict[str, Any]) -> None:
    """The figures as JSON, where a file was asked for."""
    if output is not None:
        write_whole(output, json.dumps(document, indent=1) + "\n")
        console.print(f"written to {output}")


def _row(scene: BenchScene, yard_ms: float, what: str, threads: int, poses: int, frame_ms: list[float]) -> Row:
    p50, p99 = (float(np.percentile(frame_ms, q)) for q in (50, 99))
    return Row(
        what=what,
        gaussians=scene.gaussian_count,
        image=f"{scene.height}x{scene.width}",
        threads=threads,
        poses=poses,
        p50_ms=p50,
        p99_ms=p99,
        p50_yards=p50 / yard_ms,
        frames_per_s=1000.0 / p50,
    )


def _machine(threads: int) -> dict[str, Any]:
    return {
        "processor": processor_name(),
        "threads": threads,
        "instruction_set": cpu.INSTRUCTION_SETS[0],
        **versions(),
    }


def versions() -> dict[str, str]:
    """Of the system and of what is measured and measures, and when."""
    return {
        "system": platform.platform(),
        "python": platform.python_version(),
        "ultragray": ultragray.__version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "grpc": grpc.__version__,
        "uvicorn": version("uvicorn"),
        "measured_at": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def _title(document: dict[str, Any]) -> str:
    machine = document["machine"]
    return (
        f"{machine['processor']}, {machine['threads']} threads, {machine['instruction_set']}; "
        f"yard {document['yard_ms']:.1f} ms"
    )


def _print_table(console: Console, rows: list[Row], document: dict[str, Any]) -> None:
    machine = document["machine"]
    table = Table(title=_title(document))
    for name in ("what", "Gaussians", "image", "threads", "poses"):
        table.add_column(name, justify="left" if name == "what" else "right")
    for name in ("p50 ms", "p99 ms", "p50 yards", "frames/s", "above kernel ms"):
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(
            row.what,
            f"{row.gaussians:,}",
            row.image,
            str(row.threads),
            str(row.poses),
            f"{row.p50_ms:.2f}",
            f"{row.p99_ms:.2f}",
            f"{row.p50_yards:.3f}",
            f"{row.frames_per_s:.0f}",
            "" if row.above_kernel_ms is None else f"{row.above_kernel_ms:.2f}",
        )
    console.print(table)
    for count, memory in document["worker_memory_mb"].items():
        console.print(f"worker memory with {int(count):,} Gaussians: {memory:.0f} MB")
    told = ", ".join(f"{name} {machine[name]}" for name in ("ultragray", "torch", "numpy", "grpc", "uvicorn", "python"))
    console.print(told, style="dim")
