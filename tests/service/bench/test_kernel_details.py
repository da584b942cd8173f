"""`ultragray bench --kernel-details`: parts that add up, and counts that those who know a frame by heart expect."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe, SceneInfo
from ultragray.rendering.backends import cpu
from ultragray_service.bench import kernel_details as bench
from ultragray_service.bench import report
from ultragray_service.bench.kernel_details import LANES, View

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=40.0)


def one_gaussian(sigma_mm: float) -> GaussianScene:
    """A round one in the middle of the image, that does not absorb."""
    splats = {
        "means": torch.tensor([[0.0, 0.0, 2.0]]),
        "scales": torch.full((1, 3), math.log(sigma_mm / 10.0)),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "transmittances": torch.tensor([20.0]),
        "sh0": torch.zeros(1, 1, 1),
        "shN": torch.zeros(1, 0, 1),
    }
    return GaussianScene.from_splats(splats, info=SceneInfo(probe=PROBE, image_height=80, image_width=80))


@pytest.mark.parametrize("instruction_set", cpu.INSTRUCTION_SETS)
def test_the_work_of_a_gaussian_is_its_footprint(instruction_set: str) -> None:
    scene = one_gaussian(sigma_mm=1.0)
    strips = cpu.drawing_work(scene, PROBE, np.eye(4)[None], 80, 80, instruction_set=instruction_set)
    assert strips["slices"].shape == (1, 2)
    assert strips["slices"].tolist() == [[1, 0]]  # its last scan line is the 47th
    work = {name: counts.sum() for name, counts in strips.items()}
    across = 2 * math.ceil(3.33 / 0.5)  # scan lines within its reach on either side, half a millimetre apart
    assert work["slices"] == 1
    assert across / LANES[instruction_set] <= work["groups"] <= across / LANES[instruction_set] + 2
    assert math.pi * 3.33**2 / 0.25 <= work["lanes"]  # the pixels of the ellipse
    assert work["lanes"] <= work["rows"] * LANES[instruction_set]


def test_nothing_to_draw_is_no_work() -> None:
    away = np.eye(4)[None].copy()
    away[0, 1, 3] = 5.0
    assert not any(counts.any() for counts in cpu.drawing_work(one_gaussian(1.0), PROBE, away, 80, 80).values())


def test_bench_of_the_kernels_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def tiny(quick: bool) -> Iterator[View]:
        yield View("one", one_gaussian(1.0), PROBE, np.eye(4)[None].repeat(4, 0), 80, 80)

    monkeypatch.setattr(bench, "views", tiny)
    monkeypatch.setattr(report, "time_yard_ms", lambda: 4.0)
    bench.run(tmp_path / "kernel.json", quick=True)
    rows = json.loads((tmp_path / "kernel.json").read_text())["rows"]
    assert [row["instruction_set"] for row in rows] == list(cpu.INSTRUCTION_SETS)
    for row in rows:
        parts = row["slicing_ms"] + row["drawing_ms"] + row["finishing_ms"]
        assert parts == pytest.approx(row["frame_ms"])
        assert 0.0 < row["lanes_used"] <= 1.0
        assert row["modelled_speedups"]["2"] < 2.0  # all of it lies in one of two strips
        assert row["modelled_speedups"]["16"] >= row["modelled_speedups"]["2"]
    printed = capsys.readouterr().out
    assert all(f"{row['groups']:,.0f}" in printed for row in rows)
