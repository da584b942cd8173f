"""The bench of jobs, with tiny numbers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ultragray.datasets import Dataset, Sweep
from ultragray.phantom import PHANTOM_PROBE as PROBE
from ultragray.phantom import freehand_poses, simulate
from ultragray_service.bench import jobs as bench
from ultragray_service.bench import report
from ultragray_service.bench.jobs import JobsExtent


def small_phantom() -> Dataset:
    poses = freehand_poses(8)
    images = simulate(poses, probe=PROBE, height=32, width=24)
    sweep = Sweep(images, poses, PROBE, np.arange(8), "phantom")
    return Dataset("phantom", sweep.select([0, 1, 2, 4, 5, 6]), sweep.select([3, 7]))


@pytest.mark.long
def test_bench_of_jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(bench, "load_phantom", small_phantom)
    monkeypatch.setattr(bench, "STEPS", 100_000)
    monkeypatch.setattr(report, "time_yard_ms", lambda: 4.0)
    monkeypatch.setattr(bench, "JobsExtent", lambda **less: JobsExtent(150, 3, 1, 0.3, 32))
    bench.run(tmp_path / "jobs.json", quick=True)
    document = json.loads((tmp_path / "jobs.json").read_text())
    assert document["extent"] == {"jobs": 150, "pages": 3, "rounds": 1, "seconds": 0.3, "side": 32}
    assert list(document["latency_ms"]) == [
        "page of 50, newest",
        "page of 50, in the middle",
        "frame, alone",
        "frame, beside a training",
    ]
    assert all(0.0 < times["p50"] <= times["p99"] for times in document["latency_ms"].values())
    frames = [document["latency_ms"][what]["p99"] for what in ("frame, alone", "frame, beside a training")]
    assert document["p99_ratio"] == pytest.approx(frames[1] / frames[0])
    assert "ready with 150 jobs after " in capsys.readouterr().out
