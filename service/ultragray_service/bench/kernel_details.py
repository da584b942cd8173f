"""`ultragray bench --kernel-details`: where the time of a frame goes in the kernel, and what it does there.

Slicing is timed by asking for the cost of a frame, which slices without drawing; finishing by a frame that shows
nothing. Drawing is the rest.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ultragray import GaussianScene
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.sweep import spread_places
from ultragray.phantom.demo import load_demo_scene
from ultragray.rendering.backends import cpu
from ultragray_service.bench.kernel import PROBE, bench_poses, bench_scenes, time_ms
from ultragray_service.bench.report import Report

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


def run(output: Path | None, quick: bool) -> None:
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
