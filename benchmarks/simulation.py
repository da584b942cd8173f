"""Simulates 1,000 replicas behind Envoy, 100,000 clients and 10,000 scenes: `make simulation`, for docs/scaling.md.

The costs of frames are those of `make bench`; the loading of a scene is measured here. All that is random is seeded:
the same costs give the same figures.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from figures import kept, read, write
from ultragray import render
from ultragray_studies.bench.kernel import BenchScene, bench_poses, bench_scenes
from ultragray_studies.bench.report import measured
from ultragray_studies.scaling import STUDIES, Outcome, Policy, SceneCosts, Storage, Workload, run
from ultragray_workers.pool.worker import SceneCache
from ultragray_workers.scenes import resident_bytes

SEEDS = 5
SIDE, REPEATS = 512, 9
_P99_OF_NORMAL = 2.3263
_STUDENTS_T = 2.776  # 97.5% quantile of the t distribution of 5 values


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition(":")[0])
    parser.add_argument("--only", nargs="+", choices=list(STUDIES), metavar="STUDY", help=", ".join(STUDIES))
    given = parser.parse_args()
    head, costs = measured(1), measured_costs()
    studies = {name: cases for name, cases in STUDIES.items() if given.only is None or name in given.only}
    cases = list(dict.fromkeys(case for rows in studies.values() for case in rows.values()))
    runs = [(case, costs, seed) for case in cases for seed in range(SEEDS)]
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn")) as processes:
        for outcome in processes.map(run, *zip(*runs, strict=True)):
            outcomes.append(outcome)
            sys.stderr.write(f"\r{len(outcomes)} of {len(runs)} runs")
    sys.stderr.write("\n")
    found = {case: with_confidence(outcomes[SEEDS * i : SEEDS * (i + 1)]) for i, case in enumerate(cases)}
    document = {
        "measured": head,
        **({"quick": True} if given.only else {}),
        "seeds": SEEDS,
        "costs": [asdict(one) for one in costs],
        **{type(one).__name__.lower(): asdict(one) for one in (Storage(), Workload(), Policy())},
        "studies": {study: {name: found[case] for name, case in rows.items()} for study, rows in studies.items()},
    }
    write("simulation", document)


def measured_costs() -> list[SceneCosts]:
    """The costs of the two scenes of `make bench`, the small one first."""
    streams = {row["gaussians"]: row for row in read(kept("results"))["rows"] if row["what"] == "gRPC stream"}
    scenes = sorted(bench_scenes(quick=False), key=lambda scene: scene.gaussian_count)
    return [_costs(scene, streams[scene.gaussian_count]) for scene in scenes]


def _costs(scene: BenchScene, stream: dict[str, Any]) -> SceneCosts:
    """The latency of a lone frame has the spread; the rate of eight in flight has the time that a frame takes."""
    frame_s = 1.0 / stream["frames_per_s"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ugr"
        scene.scene.save(path)
        return SceneCosts(
            gaussians=scene.gaussian_count,
            file_bytes=path.stat().st_size,
            resident_bytes=resident_bytes(scene.scene.info),
            load_s=round(min(_load_s(path) for _ in range(REPEATS)), 4),
            frame_s=frame_s,
            overhead_s=max(0.0, stream["p50_ms"] / 1000.0 - frame_s),
            spread=math.log(stream["p99_ms"] / stream["p50_ms"]) / _P99_OF_NORMAL,
        )


def _load_s(path: Path) -> float:
    """Processor time, which other programs hardly disturb: reading, hashing, and what the first frame prepares."""
    torch.set_num_threads(1)
    cache, clock = SceneCache(2**33, torch.device("cpu")), time.process_time
    began = clock()
    scene = cache.get("scene", str(path)).scene
    render(scene, None, bench_poses(1), height=SIDE, width=SIDE)
    loaded = clock()
    render(scene, None, bench_poses(1), height=SIDE, width=SIDE)
    return (loaded - began) - (clock() - loaded)


def with_confidence(outcomes: Sequence[Outcome]) -> dict[str, list[float]]:
    """Of each figure the mean over SEEDS runs, and half the width of its 95% confidence interval."""
    found = {}
    for field in fields(Outcome):
        values = [getattr(one, field.name) for one in outcomes]
        half = _STUDENTS_T * float(np.std(values, ddof=1)) / math.sqrt(len(values))
        found[field.name] = [float(f"{np.mean(values):.5g}"), float(f"{half:.2g}")]
    return found


if __name__ == "__main__":
    main()
