"""`ultragray bench`: the cost of a frame in the kernel and through each front door, here and now.

Machines drift, so every time is also given in yards, a fixed piece of work timed in the same run (docs/physics.md §5).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeAlias

import torch

from ultragray_service.bench.kernel import BenchScene, bench_scenes, measure_kernel
from ultragray_service.bench.report import Report, percentiles
from ultragray_service.bench.served import measure_served

Row: TypeAlias = dict[str, Any]
COLUMNS = {
    "what": "{what}",
    "Gaussians": "{gaussians:,}",
    "image": "{image}",
    "threads": "{threads}",
    "poses": "{poses}",
    "p50 ms": "{p50_ms:.2f}",
    "p99 ms": "{p99_ms:.2f}",
    "p50 yards": "{p50_yards:.3f}",
    "frames/s": "{frames_per_s:.0f}",
    "above kernel ms": "{above_kernel_ms:.2f}",
}


def run(output: Path | None, quick: bool) -> None:
    """Print the table; write it as JSON to `output`. `quick` takes few repetitions and leaves the large scene out."""
    report = Report(output, quick)
    repeats = 20 if quick else 200
    threads = torch.get_num_threads()
    rows: list[Row] = []
    memory_mb: dict[str, float] = {}
    report.time_yard()
    for scene in bench_scenes(quick):
        report.tell(f"{scene.gaussian_count:,} Gaussians: kernel ...")
        timings = measure_kernel(scene, sorted({1, threads}), repeats)
        yard = report.time_yard()
        kernel = [_row(scene, yard, one.what, one.threads, one.poses, one.frame_ms) for one in timings]
        kernel_p50 = next(row["p50_ms"] for row in kernel if (row["threads"], row["poses"]) == (threads, 1))
        report.tell(f"{scene.gaussian_count:,} Gaussians: served ...")
        served = measure_served(scene, repeats, "cpu")
        memory_mb[str(scene.gaussian_count)] = served.worker_memory_mb
        yard = report.time_yard()
        rows += kernel
        for door in served.front_doors:
            row = _row(scene, yard, door.what, threads, 1, door.latency_ms)
            rows.append({**row, "frames_per_s": door.frames_per_s, "above_kernel_ms": row["p50_ms"] - kernel_p50})
    document = report.cpu_document(worker_memory_mb=memory_mb, rows=rows)
    versions = document["versions"]
    names = ("ultragray", "torch", "numpy", "grpc", "uvicorn", "python")
    report.conclude(
        document,
        COLUMNS,
        rows,
        [
            *(f"worker memory with {int(count):,} Gaussians: {mb:.0f} MB" for count, mb in memory_mb.items()),
            ", ".join(f"{name} {versions[name]}" for name in names),
        ],
    )


def _row(scene: BenchScene, yard_ms: float, what: str, threads: int, poses: int, frame_ms: list[float]) -> Row:
    """One measurement: times per frame of `poses` rendered together; `above_kernel_ms` is for front doors."""
    p50, p99 = percentiles(frame_ms, 50, 99)
    return {
        "what": what,
        "gaussians": scene.gaussian_count,
        "image": f"{scene.height}x{scene.width}",
        "threads": threads,
        "poses": poses,
        "p50_ms": p50,
        "p99_ms": p99,
        "p50_yards": p50 / yard_ms,
        "frames_per_s": 1000.0 / p50,
        "above_kernel_ms": None,
    }
