"""`ultragray bench --train`: what a training step costs, and which part of it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ultragray import GaussianScene, render
from ultragray.training.geometry import spatial_order
from ultragray.training.losses import image_loss
from ultragray.training.optimizer import Optimizer

from .bench_kernel import BATCH, PROBE, BenchScene, bench_poses

PARTS = ("forward", "loss", "backward", "optimizer")


@dataclass(frozen=True)
class TrainingTiming:
    """Times of whole steps and of their parts, ms."""

    step_ms: list[float]
    part_ms: dict[str, list[float]]

    def share(self, part: str) -> float:
        """Of a part in the step, by medians."""
        return float(np.median(self.part_ms[part]) / np.median(self.step_ms))


def training_scenes() -> list[BenchScene]:
    """The paper's size, and that of a small data set."""
    return [BenchScene(500_000, 0.03), BenchScene(60_000, 0.06, height=128, width=256)]


def measure_training(bench: BenchScene, threads: int, repeats: int) -> TrainingTiming:
    """Steps of 8 images: render, loss, backward, Adam, on Gaussians in the order that the trainer keeps them in."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    order = spatial_order(bench.scene.means)
    parameters: dict[str, Any] = {
        name: t[order].contiguous().requires_grad_() for name, t in bench.scene.splats.items()
    }
    scene = GaussianScene(**parameters, info=bench.scene.info)
    poses = bench_poses(BATCH)
    truth = torch.rand((BATCH, bench.height, bench.width), generator=torch.Generator().manual_seed(1))
    optimizer = Optimizer(parameters, batch_size=BATCH)
    rates = dict.fromkeys(parameters, 1e-6)
    ticks = []
    try:
        for _ in range(repeats + 1):
            at = [time.perf_counter()]
            frames = render(scene, PROBE, poses, height=bench.height, width=bench.width, outputs=("bmode",))
            at.append(time.perf_counter())
            assert frames.bmode is not None
            loss = image_loss(frames.bmode, truth)
            at.append(time.perf_counter())
            loss.backward()  # type: ignore[no-untyped-call]
            at.append(time.perf_counter())
            optimizer.step(rates)
            at.append(time.perf_counter())
            ticks.append(at)
    finally:
        torch.set_num_threads(before)
    spent = 1000.0 * np.diff(np.array(ticks[1:]), axis=1)  # [repeats, parts]; the first step allocates
    return TrainingTiming(
        step_ms=spent.sum(axis=1).tolist(),
        part_ms={part: spent[:, k].tolist() for k, part in enumerate(PARTS)},
    )
