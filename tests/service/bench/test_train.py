"""The bench of a training step: its parts are the step."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ultragray_service.bench.kernel import BenchScene
from ultragray_service.bench.train import PARTS, measure_training

TINY = BenchScene(300, 0.1, height=24, width=20)


def test_parts_make_up_the_step() -> None:
    timing = measure_training(TINY, threads=1, repeats=3)
    assert list(timing.part_ms) == list(PARTS)
    assert len(timing.step_ms) == 3
    assert np.sum(list(timing.part_ms.values()), axis=0).tolist() == pytest.approx(timing.step_ms)
    assert min(min(times) for times in timing.part_ms.values()) > 0.0
    assert all(0.0 < timing.share(part) < 1.0 for part in PARTS)


def test_leaves_the_scene_and_the_threads_as_they_were() -> None:
    before = {name: tensor.clone() for name, tensor in TINY.scene.splats.items()}
    threads = torch.get_num_threads()
    measure_training(TINY, threads=threads + 1, repeats=1)
    assert torch.get_num_threads() == threads
    assert all(torch.equal(before[name], tensor) for name, tensor in TINY.scene.splats.items())
