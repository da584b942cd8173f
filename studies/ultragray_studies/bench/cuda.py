"""Frames and training steps of a GPU, beside what it can do at most (`--backend cuda`)."""

from __future__ import annotations

import itertools
import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
import triton
import triton.language as tl

from ultragray import GaussianScene
from ultragray.geometry.probe import FloatArray
from ultragray.learn.training.memory import forget_peak_memory, peak_memory_mb
from ultragray.rendering.backends import cuda
from ultragray.rendering.backends.cuda.work import Work, count_work
from ultragray_studies.bench.kernel import BATCH, PROBE, BenchScene, bench_poses, bench_scenes, elapsed_ms, finish, mark
from ultragray_studies.bench.parts import PARTS, measure_training, training_scenes
from ultragray_studies.bench.report import Report, measured, percentiles, versions
from ultragray_studies.bench.served import measure_served
from ultragray_workers.pool.pixels import round_to_uint8

COPY_BYTES = 2 << 30  # far more than any cache holds
REPEATS = 10
LANES = 1024  # values of a program
CHAINS = 4  # multiply-adds of a value that do not wait for each other
PROGRAMS, ROUNDS = 16_384, 2_048


@dataclass(frozen=True)
class Limits:
    """The best of a few repetitions. A multiply-add is two operations; a copied byte is read and written."""

    bytes_per_s: float
    operations_per_s: float


def measure_limits(device: torch.device) -> Limits:
    """By a copy within the device's memory, and by a kernel of nothing but fp32 multiply-adds in registers."""
    copy_bytes, programs, rounds = (1 << 20, 2, 4) if cuda.interpreted() else (COPY_BYTES, PROGRAMS, ROUNDS)
    source = torch.zeros(copy_bytes, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    values = torch.empty(programs * LANES, device=device)
    copy_ms = _best_ms(device, lambda: target.copy_(source))
    multiply_ms = _best_ms(device, lambda: multiply_add[(programs,)](values, 0.5, 0.25, rounds, LANES=LANES))
    return Limits(
        bytes_per_s=2 * copy_bytes / (copy_ms / 1000.0),
        operations_per_s=2 * CHAINS * rounds * programs * LANES / (multiply_ms / 1000.0),
    )


def _best_ms(device: torch.device, work: Callable[[], object]) -> float:
    marks = [mark(device)]
    for _ in range(REPEATS):
        work()
        marks.append(mark(device))
    finish(device)
    return min(elapsed_ms(*pair) for pair in pairwise(marks[1:]))  # the first compiles


@triton.jit  # type: ignore[untyped-decorator]
def multiply_add(out, factor, term, rounds, LANES: tl.constexpr):  # type: ignore[no-untyped-def]  # noqa: N803
    """out[i]: the sum of four chains of x ← x·factor + term, `rounds` long, which begin at 0, 1, 2 and 3 + i·1e-6."""
    places = tl.program_id(0) * LANES + tl.arange(0, LANES)
    a = places * 1e-6
    b, c, d = a + 1.0, a + 2.0, a + 3.0
    for _ in range(rounds):
        a = a * factor + term
        b = b * factor + term
        c = c * factor + term
        d = d * factor + term
    tl.store(out + places, a + b + c + d)


def gpu_document(device: torch.device, **figures: Any) -> dict[str, Any]:
    """A document that begins with commit, date, machine, versions and the GPU with its driver."""
    gpu: dict[str, Any] = {"renderer": cuda.renderer(device)}
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        gpu |= {
            "name": properties.name,
            "memory_mb": properties.total_memory / 1e6,
            "multiprocessors": properties.multi_processor_count,
            "driver": _driver_version(),
        }
    gpu |= {"cuda": torch.version.cuda, "triton": triton.__version__}
    return {"measured": measured(torch.get_num_threads()), "versions": versions(), "gpu": gpu, **figures}


def _driver_version() -> str | None:
    """The version of the NVIDIA driver, where its own tool is there to tell."""
    if (tool := shutil.which("nvidia-smi")) is None:
        return None
    command = [tool, "--query-gpu=driver_version", "--format=csv,noheader"]
    versions_of_gpus = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()
    return versions_of_gpus[0] if versions_of_gpus else None


# `ultragray bench --backend cuda`: frames of a GPU, on the device, copied to the host, and served.
#
# Beside each rate stands the distance to the hardware's limit: the bytes that a frame moves and the operations that
# it takes, counted by `ultragray.rendering.backends.cuda.work`, times the rate, over what `measure_limits` found the
# device to do at most.


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


def bench_frames(output: Path | None, quick: bool) -> None:
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


# `ultragray bench --backend cuda --train`: a training step on a GPU, its parts and its memory.


STEPS = 200  # a tenth of them where it is to be quick


def bench_training(output: Path | None, quick: bool) -> None:
    """Print the table; write it as JSON to `output`. `quick` takes few repetitions and leaves the large scene out."""
    report, device = Report(output, quick), cuda.device()
    rows: list[dict[str, Any]] = []
    for bench in training_scenes()[1 if quick else 0 :]:
        report.tell(f"{bench.gaussian_count:,} Gaussians: training ...")
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
    report.conclude(
        gpu_document(device, rows=rows),
        {
            "Gaussians": "{gaussians:,}",
            "images": "{images}",
            "step ms": "{step_ms:.2f}",
            **{f"{part} ms": f"{{part_ms[{part}]:.2f}}" for part in PARTS},
            "peak MB": "{peak_memory_mb:,.0f}",
        },
        rows,
    )
