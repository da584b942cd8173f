"""`ultragray bench --train`: the cost of a training step, and of its parts."""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ultragray import GaussianScene, render
from ultragray.learn.training.config import TEXTURE
from ultragray.learn.training.losses import image_loss
from ultragray.learn.training.optimizer import Optimizer
from ultragray.rendering.backends.inputs import spatial_order
from ultragray_service.bench.kernel import BATCH, PROBE, BenchScene, Mark, bench_poses, elapsed_ms, finish, mark
from ultragray_service.bench.report import Report

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
        """The share of a part in the step, by medians."""
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
        loss = image_loss(frames.bmode, truth, TEXTURE)
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


def run(output: Path | None, quick: bool) -> None:
    """Print the table; write it as JSON to `output`. `quick` takes few repetitions and leaves the large scene out."""
    report = Report(output, quick)
    threads = torch.get_num_threads()
    rows: list[dict[str, Any]] = []
    for scene in training_scenes()[1 if quick else 0 :]:
        report.tell(f"{scene.gaussian_count:,} Gaussians: training ...")
        report.time_yard()
        timing = measure_training(scene, threads, repeats=5 if quick else 20)
        step_ms = float(np.median(timing.step_ms))
        rows.append(
            {
                "gaussians": scene.gaussian_count,
                "images": f"{BATCH} of {scene.height}x{scene.width}",
                "threads": threads,
                "step_ms": step_ms,
                "step_yards": step_ms / report.time_yard(),
                "shares": {part: timing.share(part) for part in PARTS},
            }
        )
    report.conclude(
        report.cpu_document(rows=rows),
        {
            "Gaussians": "{gaussians:,}",
            "images": "{images}",
            "step ms": "{step_ms:.0f}",
            "yards": "{step_yards:.1f}",
            **{part: f"{{shares[{part}]:.0%}}" for part in PARTS},
        },
        rows,
    )
