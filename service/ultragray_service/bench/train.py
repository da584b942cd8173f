"""`ultragray bench --train`: what a training step costs, and which part of it."""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from ultragray import GaussianScene, render
from ultragray.backends.spatial_order import spatial_order
from ultragray.training.losses import image_loss
from ultragray.training.optimizer import Optimizer

from .clock import Mark, elapsed_ms, finish, mark
from .kernel import BATCH, PROBE, BenchScene, bench_poses

CPU = torch.device("cpu")
PARTS = ("forward", "loss", "backward", "optimizer")


@dataclass(frozen=True)
class TrainingTiming:
    """Times of whole steps and of their parts, ms, as the device counts them.

    `wall_ms` is the mean of a step by the host's clock, with the loss read back after each as the trainer does.
    """

    step_ms: list[float]
    part_ms: dict[str, list[float]]
    wall_ms: float

    def share(self, part: str) -> float:
        """Of a part in the step, by medians."""
        return float(np.median(self.part_ms[part]) / np.median(self.step_ms))


def training_scenes() -> list[BenchScene]:
    """The paper's size, and that of a small data set."""
    return [BenchScene(500_000, 0.03), BenchScene(60_000, 0.06, height=128, width=256)]


def measure_training(
    bench: BenchScene, threads: int, repeats: int, device: torch.device = CPU, backend: str = "cpu"
) -> TrainingTiming:
    """Steps of 8 images: render, loss, backward, Adam, on Gaussians in the order that the trainer keeps them in."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    order = spatial_order(bench.scene.means)
    parameters: dict[str, Any] = {
        name: t[order].contiguous().to(device).requires_grad_() for name, t in bench.scene.splats.items()
    }
    scene = GaussianScene(**parameters, info=bench.scene.info)
    poses = bench_poses(BATCH)
    size = (bench.height, bench.width)
    truth = torch.rand((BATCH, *size), generator=torch.Generator().manual_seed(1)).to(device)
    optimizer = Optimizer(parameters, batch_size=BATCH)
    rates = dict.fromkeys(parameters, 1e-6)

    def step() -> list[Mark]:
        at = [mark(device)]
        frames = render(scene, PROBE, poses, height=size[0], width=size[1], outputs=("bmode",), backend=backend)
        at.append(mark(device))
        assert frames.bmode is not None
        loss = image_loss(frames.bmode, truth)
        at.append(mark(device))
        loss.backward()  # type: ignore[no-untyped-call]
        at.append(mark(device))
        optimizer.step(rates)
        at.append(mark(device))
        float(loss.detach())
        return at

    try:
        step()  # allocates, and on a GPU compiles
        started = time.perf_counter()
        marks = [step() for _ in range(repeats)]
        finish(device)
        wall_ms = 1000.0 * (time.perf_counter() - started) / repeats
    finally:
        torch.set_num_threads(before)
    spent = np.array([[elapsed_ms(*pair) for pair in pairwise(at)] for at in marks])  # [R, parts]
    return TrainingTiming(
        step_ms=spent.sum(axis=1).tolist(),
        part_ms={part: spent[:, k].tolist() for k, part in enumerate(PARTS)},
        wall_ms=wall_ms,
    )
