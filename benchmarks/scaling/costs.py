"""What the service's work costs, all measured: frames by `make bench`, the loading of a scene here.

Object storage was not measured: `Storage` holds assumptions.
"""

from __future__ import annotations

import json
import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from registry import FIGURES
from ultragray import render
from ultragray_studies.bench.kernel import BenchScene, bench_poses, bench_scenes
from ultragray_workers.pool.scene_cache import SceneCache
from ultragray_workers.scenes import resident_bytes

REPEATS = 9
SIDE = 512  # pixels, as in `make bench`
_P99_OF_NORMAL = 2.3263


@dataclass(frozen=True)
class SceneCosts:
    """What one scene costs a replica of two cores whose one render process has both."""

    gaussians: int
    file_bytes: int
    resident_bytes: int
    load_s: float  # processor time on one thread of the render process, in which it renders nothing else
    frame_s: float  # mean time of a frame of a gRPC stream that is kept busy
    overhead_s: float  # of the door, in which other frames are rendered
    spread: float  # standard deviation of the logarithm of a frame's time


@dataclass(frozen=True)
class Storage:
    """Assumed, not measured: a fetch from object storage in the same region."""

    first_byte_s: float = 0.03
    bytes_per_s: float = 100e6

    def fetch_s(self, size: int) -> float:
        """Time until an object of `size` bytes is here."""
        return self.first_byte_s + size / self.bytes_per_s


def measured_costs() -> list[SceneCosts]:
    """The costs of the two scenes of `make bench`, the small one first."""
    rows = json.loads(FIGURES["results"].kept.read_text(encoding="utf-8"))["rows"]
    scenes = sorted(bench_scenes(quick=False), key=lambda scene: scene.gaussian_count)
    return [_costs(scene, _stream(rows, scene.gaussian_count)) for scene in scenes]


def _stream(rows: list[dict[str, Any]], gaussians: int) -> dict[str, Any]:
    return next(row for row in rows if row["what"] == "gRPC stream" and row["gaussians"] == gaussians)


def _costs(scene: BenchScene, stream: dict[str, Any]) -> SceneCosts:
    """The latency of a lone frame has the spread; the rate of eight in flight has the time that a frame takes."""
    frame_s = 1.0 / stream["frames_per_s"]
    spread = math.log(stream["p99_ms"] / stream["p50_ms"]) / _P99_OF_NORMAL
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
            spread=spread,
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
