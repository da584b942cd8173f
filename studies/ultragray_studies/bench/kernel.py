"""The kernel's own time, the yard it is measured with, and time as a device counts it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from ultragray import GaussianScene, LinearProbe, SceneInfo
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.backends import cpu

BLOCK_CM = 5.0
PROBE = LinearProbe(width_mm=50.0, near_mm=0.0, far_mm=50.0)
BATCH = 8
REST_S = 0.003  # in which a processor falls asleep

Mark = float | torch.cuda.Event  # seconds of the host's clock, or a place in the device's queue


@dataclass(frozen=True)
class BenchScene:
    """A block of random Gaussians, 5x5x5 cm, its scales log-normal around `scale_cm`."""

    gaussian_count: int
    scale_cm: float
    height: int = 512
    width: int = 512

    @cached_property
    def scene(self) -> GaussianScene:
        generator = torch.Generator().manual_seed(0)

        def normal(*shape: int) -> torch.Tensor:
            return torch.randn(*shape, generator=generator)

        n = self.gaussian_count
        splats = {
            "means": (torch.rand(n, 3, generator=generator) - 0.5) * BLOCK_CM,
            "scales": math.log(self.scale_cm) + 0.3 * normal(n, 3),
            "quats": normal(n, 4),
            "transmittances": 3.0 + normal(n),
            "sh0": -1.0 + 0.5 * normal(n, 1, 1),
            "shN": 0.2 * normal(n, 3, 1),
        }
        info = SceneInfo(probe=PROBE, image_height=self.height, image_width=self.width)
        return GaussianScene.from_splats(splats, info=info)


def bench_scenes(quick: bool) -> list[BenchScene]:
    """The two scenes of the paper's sizes, or only the small one."""
    small = BenchScene(90_000, 0.05)
    return [small] if quick else [BenchScene(500_000, 0.03), small]


def bench_poses(count: int) -> FloatArray:  # [C, 4, 4] mm
    """Planes through the middle of the block, moving in elevation and turning a little."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    angles = np.radians(np.linspace(-3.0, 3.0, count)) if count > 1 else np.zeros(1)
    poses[:, 1, 1] = poses[:, 2, 2] = np.cos(angles)
    poses[:, 2, 1] = np.sin(angles)
    poses[:, 1, 2] = -np.sin(angles)
    poses[:, 1, 3] = np.linspace(-2.0, 2.0, count) if count > 1 else 0.0
    poses[:, 2, 3] = -BLOCK_CM * 5.0
    return poses


@dataclass(frozen=True)
class KernelTiming:
    """Times per frame of one way to call the kernel."""

    what: str
    threads: int
    poses: int
    frame_ms: list[float]


def measure_kernel(bench: BenchScene, thread_counts: Sequence[int], repeats: int) -> list[KernelTiming]:
    """One pose, a batch of 8, and one pose after a rest as control loops have it; B-mode, on each number of threads."""
    scene = bench.scene
    before = torch.get_num_threads()
    timings = []
    try:
        for threads in thread_counts:
            torch.set_num_threads(threads)
            for what, poses, rest_s in (("kernel", 1, 0.0), ("kernel", BATCH, 0.0), ("kernel, rested", 1, REST_S)):
                poses_cm = scene.poses_to_scene_cm(bench_poses(max(repeats, 10 * poses)))
                frame_ms = []
                for first in range(0, len(poses_cm) - poses + 1, poses):
                    views = poses_cm[first : first + poses]
                    size = (bench.height, bench.width)
                    time.sleep(rest_s)
                    frame_ms.append(time_ms(cpu.render_outputs, scene, PROBE, views, *size, ("bmode",)) / poses)
                timings.append(KernelTiming(what, threads, poses, frame_ms[1:]))
    finally:
        torch.set_num_threads(before)
    return timings


def time_ms(work: Callable[..., object], *arguments: Any) -> float:
    """The time of one call by the host's clock, ms."""
    started = time.perf_counter()
    work(*arguments)
    return 1000.0 * (time.perf_counter() - started)


def time_yard_ms() -> float:
    """The median time of 36 million float32 exponentials by torch on one thread, ms (docs/physics.md §5)."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    x = -torch.rand(7_200_000)
    y = torch.empty_like(x)
    times = []
    for _ in range(7):
        started = time.perf_counter()
        for _ in range(5):
            torch.exp(x, out=y)
        times.append(1000.0 * (time.perf_counter() - started))
    torch.set_num_threads(before)
    return float(np.median(times))


def mark(device: torch.device) -> Mark:
    """The time now, or on a GPU when all that was queued before is done."""
    if device.type == "cpu":
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]
    event.record()
    return event


def elapsed_ms(first: Mark, last: Mark) -> float:
    """The time between two marks of one device, which has done what was queued before the last."""
    if isinstance(first, float) or isinstance(last, float):
        assert isinstance(first, float)
        assert isinstance(last, float)
        return 1000.0 * (last - first)
    return float(first.elapsed_time(last))


def finish(device: torch.device) -> None:
    """Wait until the device has done what was queued."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
