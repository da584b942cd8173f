"""`ultragray bench --backend cuda`: frames of a GPU, on the device, copied to the host, and served.

Beside each rate stands the distance to the hardware's limit: the bytes that a frame moves and the operations that it
takes, counted by `ultragray.rendering.backends.cuda.work`, times the rate, over what `measure_limits` found the device
to do at
most.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeAlias

import torch

from ultragray import GaussianScene
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.backends import cuda
from ultragray.rendering.backends.cuda.work import Work, count_work
from ultragray_service.bench.cuda.gpu import Limits, gpu_document, measure_limits
from ultragray_service.bench.kernel import PROBE, BenchScene, bench_poses, bench_scenes, elapsed_ms, finish, mark
from ultragray_service.bench.report import Report, percentiles
from ultragray_service.bench.served import measure_served
from ultragray_workers.pool.pixels import round_to_uint8

BATCHES = (1, 8, 64, 256)  # poses rendered by one call
POSES = 256  # that the calls go through
COUNTED = 8  # of them, evenly, whose work is counted: all at once would take 10 GB
ROUNDS = 16  # through all poses; a quarter of them where it is to be quick
ON_DEVICE, ON_HOST = "frames on the GPU", "8-bit frames on the host"
LATENCY_CALLS = 50  # at most, one at a time; the rates come from calls queued behind each other


Row: TypeAlias = dict[str, Any]
COLUMNS = {
    "what": "{what}",
    "Gaussians": "{gaussians:,}",
    "poses": "{poses}",
    "p50 ms": "{p50_ms:.3f}",
    "p99 ms": "{p99_ms:.3f}",
    "frames/s": "{frames_per_s:,.0f}",
    "device's": "{device_frames_per_s:,.0f}",
    "bandwidth": "{bandwidth_share:.1%}",
    "arithmetic": "{arithmetic_share:.1%}",
}


def run(output: Path | None, quick: bool) -> None:
    """Print the table; write it as JSON to `output`. `quick` takes few repetitions and leaves the large scene out."""
    report, device = Report(output, quick), cuda.device()
    rounds = ROUNDS // 4 if quick else ROUNDS
    limits = measure_limits(device)
    rows: list[Row] = []
    work: dict[str, Any] = {}
    for bench in bench_scenes(quick):
        report.tell(f"{bench.gaussian_count:,} Gaussians: on the GPU ...")
        scene = bench.scene.to(device)
        poses_cm = scene.poses_to_scene_cm(bench_poses(POSES))
        counted = count_work(scene, PROBE, poses_cm[:: max(1, POSES // COUNTED)], bench.height, bench.width)
        work[str(bench.gaussian_count)] = asdict(counted)
        with torch.no_grad():
            for poses, what in itertools.product(BATCHES, (ON_DEVICE, ON_HOST)):
                rows.append(_measure(bench, scene, poses_cm, poses, what, rounds, counted, limits))
        del scene
        report.tell(f"{bench.gaussian_count:,} Gaussians: served ...")
        served = measure_served(bench, 20 if quick else 200, "cuda")
        rows += [
            _row(bench, door.what, 1, door.latency_ms, frames_per_s=door.frames_per_s) for door in served.front_doors
        ]
    report.conclude(
        gpu_document(device, limits=asdict(limits), work_per_frame=work, rows=rows),
        COLUMNS,
        rows,
        [
            f"limits measured here: {limits.bytes_per_s / 1e9:,.0f} GB/s copied (read and written), "
            f"{limits.operations_per_s / 1e12:.1f} Tflop/s of fp32 multiply-adds"
        ],
    )


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
            host.copy_(round_to_uint8(frames), non_blocking=True)

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


def _row(bench: BenchScene, what: str, poses: int, latency_ms: list[float], **rates: float) -> Row:
    """One measurement: times of a served frame or of one call that is waited for, and shares of the device's limits.

    `frames_per_s` is by the host's clock, `device_frames_per_s` by the device's own.
    """
    p50, p99 = percentiles(latency_ms, 50, 99)
    return {
        "what": what,
        "gaussians": bench.gaussian_count,
        "image": f"{bench.height}x{bench.width}",
        "poses": poses,
        "p50_ms": p50,
        "p99_ms": p99,
        **dict.fromkeys(("frames_per_s", "device_frames_per_s", "bandwidth_share", "arithmetic_share")),
        **rates,
    }
