"""`ultragray bench --backend cuda`: frames of a GPU, on the device, copied to the host, and served; a training step.

Beside each rate stands the distance to the hardware's limit: the bytes that a frame moves and the operations that it
takes, counted by `ultragray.backends.cuda.work`, times the rate, over what `measure_limits` found the device to do at
most.
"""

from __future__ import annotations

import itertools
import shutil
import subprocess
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import triton
from rich.table import Table

from ultragray import GaussianScene
from ultragray.backends import cuda
from ultragray.backends.cuda.work import Work, count_work
from ultragray.machine import processor_name
from ultragray.probe import FloatArray
from ultragray.training.device import forget_peak_memory, peak_memory_mb
from ultragray_workers.pool.transfer import to_uint8

from .clock import elapsed_ms, finish, mark
from .command import bench_console, versions, write_document
from .kernel import BATCH, PROBE, BenchScene, bench_poses, bench_scenes
from .limits import Limits, measure_limits
from .served import measure_served
from .train import PARTS, measure_training, training_scenes

BATCHES = (1, 8, 64, 256)  # poses rendered by one call
POSES = 256  # that the calls go through
COUNTED = 8  # of them, evenly, whose work is counted: all at once would take 10 GB
ROUNDS, STEPS = 16, 200  # through all poses, and of training; a quarter and a tenth of them where it is to be quick
ON_DEVICE, ON_HOST = "frames on the GPU", "8-bit frames on the host"
LATENCY_CALLS = 50  # at most, one at a time; the rates come from calls queued behind each other


@dataclass(frozen=True)
class Row:
    """One measurement; times of a served frame or of one call that is waited for, and shares of the device's limits."""

    what: str
    gaussians: int
    image: str  # H x W
    poses: int  # rendered together
    p50_ms: float
    p99_ms: float
    frames_per_s: float  # by the host's clock
    device_frames_per_s: float | None = None  # by the device's own clock
    bandwidth_share: float | None = None
    arithmetic_share: float | None = None


def run_cuda_bench(output: Path | None, quick: bool) -> None:
    """Prints the table; writes it as JSON to `output`. `quick` takes few repetitions and leaves the large scene out."""
    console, device = bench_console(), cuda.device()
    rounds = ROUNDS // 4 if quick else ROUNDS
    limits = measure_limits(device)
    rows: list[Row] = []
    work: dict[str, Any] = {}
    for bench in bench_scenes(quick):
        console.print(f"{bench.gaussian_count:,} Gaussians: on the GPU ...", style="dim")
        scene = bench.scene.to(device)
        poses_cm = scene.poses_to_scene_cm(bench_poses(POSES))
        counted = count_work(scene, PROBE, poses_cm[:: max(1, POSES // COUNTED)], bench.height, bench.width)
        work[str(bench.gaussian_count)] = asdict(counted)
        with torch.no_grad():
            for poses, what in itertools.product(BATCHES, (ON_DEVICE, ON_HOST)):
                rows.append(_measure(bench, scene, poses_cm, poses, what, rounds, counted, limits))
        del scene
        console.print(f"{bench.gaussian_count:,} Gaussians: served ...", style="dim")
        served = measure_served(bench, 20 if quick else 200, "cuda")
        rows += [
            _row(bench, door.what, 1, door.latency_ms, frames_per_s=door.frames_per_s) for door in served.front_doors
        ]
    document = {
        "machine": _machine(device),
        "limits": asdict(limits),
        "work_per_frame": work,
        "rows": [asdict(row) for row in rows],
    }
    table = Table(title=_title(document))
    table.add_column("what")
    for name in ("Gaussians", "poses", "p50 ms", "p99 ms", "frames/s", "device's", "bandwidth", "arithmetic"):
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(
            row.what,
            f"{row.gaussians:,}",
            str(row.poses),
            f"{row.p50_ms:.3f}",
            f"{row.p99_ms:.3f}",
            f"{row.frames_per_s:,.0f}",
            "" if row.device_frames_per_s is None else f"{row.device_frames_per_s:,.0f}",
            _percent(row.bandwidth_share),
            _percent(row.arithmetic_share),
        )
    console.print(table)
    console.print(
        f"limits measured here: {limits.bytes_per_s / 1e9:,.0f} GB/s copied (read and written), "
        f"{limits.operations_per_s / 1e12:.1f} Tflop/s of fp32 multiply-adds",
        style="dim",
    )
    write_document(console, output, document)


def _measure(
    bench: BenchScene,
    scene: GaussianScene,
    poses_cm: FloatArray,  # [POSES, 4, 4]
    poses: int,
    what: str,
    rounds: int,  # through all poses
    counted: Work,
    limits: Limits,
) -> Row:
    """Calls of `poses` poses each, B-mode only: first one at a time, then queued without waiting in between."""
    device = scene.means.device
    shape = (poses, bench.height, bench.width)
    host = torch.empty(shape, dtype=torch.uint8, pin_memory=device.type == "cuda")

    def call(first: int) -> None:
        views = poses_cm[first : first + poses]
        frames = cuda.render_outputs(scene, PROBE, views, bench.height, bench.width, ("bmode",))["bmode"]
        if what == ON_HOST:
            host.copy_(to_uint8(frames), non_blocking=True)

    places = range(0, len(poses_cm), poses)
    for first in itertools.islice(itertools.cycle(places), 3):  # compiles, allocates
        call(first)
    finish(device)
    latency_ms = []
    for first in itertools.islice(itertools.cycle(places), min(LATENCY_CALLS, rounds * len(places))):
        started = time.perf_counter()
        call(first)
        finish(device)
        latency_ms.append(1000.0 * (time.perf_counter() - started))
    started, before = time.perf_counter(), mark(device)
    for _ in range(rounds):
        for first in places:
            call(first)
    after = mark(device)
    finish(device)
    elapsed_s, frames = time.perf_counter() - started, rounds * len(poses_cm)
    rate = frames / elapsed_s
    return _row(
        bench,
        what,
        poses,
        latency_ms,
        frames_per_s=rate,
        device_frames_per_s=1000.0 * frames / elapsed_ms(before, after),
        bandwidth_share=rate * (counted.bytes_read + counted.bytes_written) / limits.bytes_per_s,
        arithmetic_share=rate * counted.operations / limits.operations_per_s,
    )


def _row(bench: BenchScene, what: str, poses: int, latency_ms: list[float], **found: float) -> Row:
    p50, p99 = (float(np.percentile(latency_ms, q)) for q in (50, 99))
    return Row(
        what=what,
        gaussians=bench.gaussian_count,
        image=f"{bench.height}x{bench.width}",
        poses=poses,
        p50_ms=p50,
        p99_ms=p99,
        **found,
    )


def run_cuda_training_bench(output: Path | None, quick: bool) -> None:
    """The same for a training step and its parts, with the most memory that it took of the GPU."""
    console, device = bench_console(), cuda.device()
    rows: list[dict[str, Any]] = []
    for bench in training_scenes()[1 if quick else 0 :]:
        console.print(f"{bench.gaussian_count:,} Gaussians: training ...", style="dim")
        forget_peak_memory(device)
        timing = measure_training(bench, torch.get_num_threads(), STEPS // 10 if quick else STEPS, device, "cuda")
        rows.append(
            {
                "gaussians": bench.gaussian_count,
                "images": f"{BATCH} of {bench.height}x{bench.width}",
                "step_ms": timing.wall_ms,
                "part_ms": {part: float(np.median(timing.part_ms[part])) for part in PARTS},
                "peak_memory_mb": peak_memory_mb(device),
            }
        )
    document = {"machine": _machine(device), "rows": rows}
    table = Table(title=_title(document))
    for name in ("Gaussians", "images", "step ms", *(f"{part} ms" for part in PARTS), "peak MB"):
        table.add_column(name, justify="right")
    for row in rows:
        peak = row["peak_memory_mb"]
        table.add_row(
            f"{row['gaussians']:,}",
            row["images"],
            f"{row['step_ms']:.2f}",
            *(f"{row['part_ms'][part]:.2f}" for part in PARTS),
            "" if peak is None else f"{peak:,.0f}",
        )
    console.print(table)
    write_document(console, output, document)


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100.0 * share:.1f} %"


def _machine(device: torch.device) -> dict[str, Any]:
    machine: dict[str, Any] = {"processor": processor_name(), "renderer": cuda.renderer(device)}
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        machine |= {
            "gpu": properties.name,
            "gpu_memory_mb": properties.total_memory / 1e6,
            "multiprocessors": properties.multi_processor_count,
            "driver": _driver_version(),
        }
    return {**machine, "cuda": torch.version.cuda, "triton": triton.__version__, **versions()}


def _driver_version() -> str | None:
    """Of the NVIDIA driver, where its own tool is there to tell."""
    if (tool := shutil.which("nvidia-smi")) is None:
        return None
    command = [tool, "--query-gpu=driver_version", "--format=csv,noheader"]
    told = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()
    return told[0] if told else None


def _title(document: dict[str, Any]) -> str:
    machine = document["machine"]
    return (
        f"{machine.get('gpu', machine['processor'])}, {machine['renderer']}; driver {machine.get('driver')}, "
        f"CUDA {machine['cuda']}, torch {machine['torch']}, triton {machine['triton']}"
    )
