"""The shadow of bone: where it lies, and what is measured in it."""

from __future__ import annotations

import numpy as np
import pytest

from ultragray import ConvexProbe, LinearProbe, Probe
from ultragray.datasets import Sweep
from ultragray.errors import DatasetInvalid

from ..scripts import benchmark

BoneShadow = benchmark("bone_shadow").BoneShadow
PROBE = LinearProbe(width_mm=60.0, near_mm=0.0, far_mm=60.0)
SIDE = 60  # a pixel a millimetre


def sweep_at(x_mm: float, probe: Probe = PROBE) -> Sweep:
    """A frame over the middle vertebra and one between two, shifted along x, of nothing but noise."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 0, 3] = x_mm
    poses[1, 1, 3] = 19.0
    images = np.random.default_rng(0).integers(0, 256, (2, SIDE, SIDE), dtype=np.uint8)
    return Sweep(images, poses, probe, np.arange(2), "noise")


def test_it_lies_behind_the_laminae_and_not_beside_or_between_them() -> None:
    over, between = BoneShadow.of(sweep_at(0.0)).hidden
    assert over[40:, 20:40].all()
    assert not over[:12].any()
    assert not over[:, :6].any()
    assert not between[:52, 26:34].any()


def test_means_are_taken_over_the_shadow_alone() -> None:
    sweep = sweep_at(0.0)
    shadow = BoneShadow.of(sweep)
    inside = shadow.hidden.astype(np.float32)
    assert shadow.mean(inside) == 1.0
    assert shadow.mean(1.0 - inside) == 0.0
    truth = (sweep.images / 255.0).astype(np.float32)
    assert shadow.mean_absolute_error(truth + 1.0 - inside) == pytest.approx(0.0, abs=1e-7)
    assert shadow.mean_absolute_error(truth - 0.25 * inside) == pytest.approx(0.25, abs=1e-6)


def test_sweeps_that_cannot_tell_are_refused() -> None:
    with pytest.raises(DatasetInvalid, match="noise: no pixel lies in the shadow"):
        BoneShadow.of(sweep_at(90.0))
    with pytest.raises(DatasetInvalid, match="noise: the phantom is scanned along upright lines, got convex probe"):
        BoneShadow.of(sweep_at(0.0, ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=50.0)))
