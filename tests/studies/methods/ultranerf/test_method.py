"""The variants of Ultra-NeRF: what they learn, in which coordinates, and that a fit can be interrupted."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, LinearProbe
from ultragray.errors import DatasetInvalid
from ultragray.learn.sweep import Dataset, Sweep
from ultragray_studies.methods import ultranerf
from ultragray_studies.methods.method import Budget
from ultragray_studies.methods.ultranerf import VARIANTS, Coordinates

SIDE = 24
LINEAR = LinearProbe(width_mm=20.0, near_mm=0.0, far_mm=20.0)
CPU = torch.device("cpu")


def sweep(probe=LINEAR, frames=3, height=SIDE, width=SIDE):
    """Frames 1 mm apart with a bright bow that shadows what lies under it."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 1, 3] = np.arange(frames)
    row, column = np.mgrid[0:height, 0:width] / (height, width)[0]
    bow = 0.4 + 0.3 * (column - 0.5) ** 2
    tissue = 70.0 + 25.0 * np.sin(9.0 * column + 2.0) * np.cos(11.0 * row)
    image = np.where((row > bow) & (np.abs(column - 0.4) < 0.25), 20.0, tissue)
    image += 110.0 * np.exp(-(((row - bow) / 0.05) ** 2)) * (np.abs(column - 0.4) < 0.25)
    images = np.stack([np.clip(image - 3.0 * place, 0, 255) for place in range(frames)]).astype(np.uint8)
    return Sweep(images, poses, probe, np.arange(frames), "bow")


def dataset(probe=LINEAR, frames=3, **size):
    train = sweep(probe, frames, **size)
    return Dataset("bow", train, train.select([0]))


def learner(method, of=None, seed=0):
    return method.learner(of or dataset(), Budget.author(), seed, CPU)


def test_the_field_sees_metres_or_the_scaled_box():
    train = sweep()
    corner = np.array([10.0, 2.0, 20.0])
    np.testing.assert_allclose(Coordinates.metres(train).of(corner), [0.010, 0.002, 0.020])
    np.testing.assert_allclose(Coordinates.scaled(train).of(corner), [1.0, 0.1, 1.0])
    np.testing.assert_allclose(Coordinates.scaled(train).of(np.array([-10.0, 0.0, 0.0])), [-1.0, -0.1, -1.0])


@pytest.mark.parametrize(("name", "length"), [("ultranerf-released", 0.020), ("ultranerf-unit", 2.0)])
def test_attenuation_is_counted_per_unit_of_the_coordinates(name, length):
    """A field of constant attenuation 1.5, no reflection, and scatterers of amplitude 1: I = exp(−1.5 depth)."""
    one = learner(next(one for one in VARIANTS if one.name == name))
    with torch.no_grad():
        one.module.head.weight.zero_()
        one.module.head.bias.copy_(torch.tensor([-1.5, -100.0, -100.0, 100.0, 100.0]))
    frame = one.render(LINEAR, np.eye(4)[None], SIDE, SIDE)[0]
    middle = frame[3:-3, SIDE // 2]
    expected = np.exp(-1.5 * length * np.arange(3, SIDE - 3) / SIDE)
    np.testing.assert_allclose(middle, expected, rtol=1e-5)


def test_a_frame_in_chunks_is_the_frame(monkeypatch):
    one = learner(VARIANTS[1])
    whole = one.render(LINEAR, np.eye(4)[None], SIDE, SIDE)
    monkeypatch.setattr(ultranerf, "CHUNK_POINTS", 100)
    np.testing.assert_allclose(one.render(LINEAR, np.eye(4)[None], SIDE, SIDE), whole, atol=1e-6)


def test_a_fan_is_rendered_along_its_own_scan_lines():
    probe = ConvexProbe(opening_angle_deg=60.0, near_mm=20.0, far_mm=60.0)
    one = learner(VARIANTS[1], dataset(probe, width=20))
    assert math.isfinite(one.take_step(0, 10))
    with torch.no_grad():
        one.module.head.weight.zero_()
        one.module.head.bias.copy_(torch.tensor([1.0, -100.0, -100.0, 100.0, 100.0]))
    frame = one.render(probe, np.eye(4)[None], SIDE, 20)[0]
    half_mm = one.coordinates.unit_mm
    expected = np.exp(-40.0 / half_mm * np.arange(3, SIDE - 3) / SIDE)  # along each line alike
    for column in (3, 10, 16):
        np.testing.assert_allclose(frame[3:-3, column], expected, rtol=1e-5)


def test_the_rate_falls_as_published_over_the_steps_of_any_budget():
    one = learner(VARIANTS[1])
    rates = []
    for step, steps in ((0, 10), (5, 10), (100_000, 200_000), (250, 250)):
        one.loss(step, steps)
        rates.append(one.optimizers["adam"].param_groups[0]["lr"])
    assert rates == pytest.approx([1e-4, 1e-4 * 0.1**0.4, 1e-4 * 0.1 ** (100_000 / 250_000), 1e-4 * 0.1**0.8])


def test_frames_too_small_for_the_loss_are_refused():
    with pytest.raises(DatasetInvalid, match="at least 7 pixels a side, got 24x6"):
        learner(VARIANTS[0], dataset(width=6))


@pytest.mark.long
def test_the_mean_variant_learns_a_single_frame_by_heart():
    train = sweep(frames=2)
    same = replace(train, images=train.images[[0, 0]], poses=train.poses[[0, 0]])
    one = learner(VARIANTS[2], Dataset("one", same, same.select([])))
    for step in range(700):
        one.take_step(step, 2000)
    frame = one.render(LINEAR, same.poses[:1], SIDE, SIDE)[0]
    assert -10.0 * math.log10(float(((frame - same.images[0] / 255.0) ** 2).mean())) > 30.0
