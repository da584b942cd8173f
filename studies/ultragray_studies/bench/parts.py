"""The parts of a frame in the kernel (`ultragray bench --kernel-details`), and of a training step (`--train`)."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ultragray import GaussianScene, render
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.sweep import spread_places
from ultragray.learn.training.config import TEXTURE
from ultragray.learn.training.losses import image_loss
from ultragray.learn.training.optimizer import Optimizer
from ultragray.phantom.demo import load_demo_scene
from ultragray.rendering.backends import cpu
from ultragray.rendering.backends.inputs import spatial_order
from ultragray_studies.bench.kernel import (
    BATCH,
    PROBE,
    BenchScene,
    Mark,
    bench_poses,
    bench_scenes,
    elapsed_ms,
    finish,
    mark,
    time_ms,
)
from ultragray_studies.bench.report import Report

ELSEWHERE_CM = 1e4  # so far away no Gaussian is cut
LANES = {"avx512": 16, "avx2": 8, "baseline": 4}  # floats of a vector
ROWS_PER_GROUP = 20  # that take as long as what a group takes before its first row
MODELLED_THREADS = (2, 4, 8, 16)
FLOAT_BYTES, TOUCHED_PLANES = 4, 3  # each of which a row loads and stores


class View(NamedTuple):
    """Some poses of a scene."""

    what: str
    scene: GaussianScene
    probe: Probe
    poses_cm: FloatArray  # [C, 4, 4]
    height: int
    width: int


def views(quick: bool) -> Iterator[View]:
    """The blocks of random Gaussians, and the demo scene at some of its training poses."""
    count = 12 if quick else 48
    for bench in bench_scenes(quick):
        poses_cm = bench.scene.poses_to_scene_cm(bench_poses(count))
        yield View(f"{bench.gaussian_count:,} random", bench.scene, PROBE, poses_cm, bench.height, bench.width)
    demo = load_demo_scene()
    assert demo.info.probe is not None
    poses = demo.training_poses[spread_places(len(demo.training_poses), count)]
    yield View("demo scene", demo, demo.info.probe, demo.poses_to_scene_cm(poses), 512, 512)


def measure_details(view: View, instruction_set: str) -> dict[str, Any]:
    """Medians of a frame's parts, ms, on one thread, and the work of drawing a frame."""
    scene, probe, size = view.scene, view.probe, (view.height, view.width)
    elsewhere = view.poses_cm.copy()
    elsewhere[:, :3, 3] += ELSEWHERE_CM
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        draw = partial(_draw, scene, probe, size, instruction_set)
        frame, finishing = _median_ms(draw, view.poses_cm), _median_ms(draw, elsewhere)
        slicing = _median_ms(partial(_slice, scene, probe, size, instruction_set), view.poses_cm)
        work = cpu.drawing_work(scene, probe, view.poses_cm, *size, instruction_set=instruction_set)
    finally:
        torch.set_num_threads(before)
    drawing = frame - slicing - finishing
    costs = work["rows"] + ROWS_PER_GROUP * work["groups"] + 1  # [C, S]
    strip_ms = (drawing * costs / costs.sum(axis=1, keepdims=True) + finishing / costs.shape[1]).tolist()
    count, lanes = len(view.poses_cm), LANES[instruction_set]
    slices, groups, rows, used = (float(work[name].sum()) / count for name in ("slices", "groups", "rows", "lanes"))
    return {
        "what": view.what,
        "instruction_set": instruction_set,
        "frame_ms": frame,
        "slicing_ms": slicing,
        "drawing_ms": drawing,
        "finishing_ms": finishing,
        "slices": slices,
        "groups": groups,
        "rows": rows,
        "lanes_used": used / (rows * lanes),
        "ns_per_row": 1e6 * drawing / rows,
        "megabytes_moved": 2 * TOUCHED_PLANES * FLOAT_BYTES * lanes * rows / 1e6,
        "modelled_speedups": {
            threads: frame / float(np.median([slicing / threads + _makespan(one, threads) for one in strip_ms]))
            for threads in MODELLED_THREADS
        },
    }


def _makespan(parts_ms: list[float], threads: int) -> float:
    """The time until all parts are done, where each thread takes the next one as soon as it is free, ms."""
    free_at = [0.0] * threads
    for part in parts_ms:
        heapq.heapreplace(free_at, free_at[0] + part)
    return max(free_at)


def _median_ms(work: Callable[[FloatArray], object], poses_cm: FloatArray) -> float:  # [C, 4, 4]
    return float(np.median([time_ms(work, pose[None]) for pose in poses_cm][1:]))


def _draw(
    scene: GaussianScene, probe: Probe, size: tuple[int, int], instruction_set: str, poses_cm: FloatArray
) -> object:
    return cpu.render_outputs(scene, probe, poses_cm, *size, ("bmode",), instruction_set=instruction_set)


def _slice(
    scene: GaussianScene, probe: Probe, size: tuple[int, int], instruction_set: str, poses_cm: FloatArray
) -> object:
    return cpu.footprint_pixels(scene, probe, poses_cm, *size, instruction_set=instruction_set)


def bench_kernel_details(output: Path | None, quick: bool) -> None:
    """Print the table; write it as JSON to `output`. `quick` takes few poses and leaves the large scene out."""
    report = Report(output, quick)
    report.time_yard()
    rows = []
    for view in views(quick):
        report.tell(f"{view.what} ...")
        rows += [measure_details(view, name) for name in cpu.INSTRUCTION_SETS]
    report.time_yard()
    report.conclude(
        report.cpu_document(rows=rows),
        {
            "scene": "{what}, {instruction_set}",
            "ms": "{frame_ms:.2f}",
            "slicing": "{slicing_ms:.2f}",
            "drawing": "{drawing_ms:.2f}",
            "finish": "{finishing_ms:.2f}",
            "groups": "{groups:,.0f}",
            "rows": "{rows:,.0f}",
            "lanes": "{lanes_used:.0%}",
            "ns/row": "{ns_per_row:.1f}",
            "MB": "{megabytes_moved:.0f}",
            **{f"x{threads}": f"{{modelled_speedups[{threads}]:.1f}}" for threads in MODELLED_THREADS},
        },
        rows,
        [
            "One thread. A group is a vector of scan lines across a slice; lanes: of its rows, those that it touches.",
            "MB: between registers and the accumulators of a strip, which stay in the level-2 cache.",
            "x2 … x16: by how much so many cores shorten a frame, modelled from the counted work of its strips.",
        ],
    )


# `ultragray bench --train`: the cost of a training step, and of its parts.


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


def bench_training(output: Path | None, quick: bool) -> None:
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
