"""Which frames a calibration leaves out: gaps, both ends, tilts, and always enough to train from."""

import numpy as np
import pytest

from ultragray import LinearProbe
from ultragray.learn.sweep import Sweep
from ultragray.learn.training.confidence import LEAST_KEPT, MAX_SHARE, STRETCHES, TURNED, held_out_frames
from ultragray.phantom import freehand_poses

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=40.0)


def sweep_at(poses):
    images = np.random.default_rng(0).integers(0, 255, (len(poses), 4, 4)).astype(np.uint8)
    return Sweep(images, poses, PROBE, np.arange(len(poses)), "test")


def straight(count):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = np.linspace(0.0, 60.0, count)
    return poses


def test_ends_and_gaps_of_several_widths_are_left_out():
    held_out = held_out_frames(sweep_at(straight(101)))
    path = held_out / 100.0
    path = path if path[0] == 0.0 and path[6] == 0.06 and path[7] > 0.06 else 1.0 - path  # either end may be the first
    for first, last in STRETCHES:
        inside = (path > first - 1e-9) & (path < last + 1e-9)
        assert inside.sum() == pytest.approx(round(100 * last) - round(100 * first) + 1, abs=1)  # an edge may round
    outside = [x for x in path if not any(first - 1e-9 < x < last + 1e-9 for first, last in STRETCHES)]
    assert 3 <= len(outside) <= 12  # single ones
    assert len(held_out) <= MAX_SHARE * 101


def test_a_gap_is_one_for_every_pass_of_the_probe():
    poses = np.concatenate([straight(60), straight(60)])
    held_out = held_out_frames(sweep_at(poses))
    first, second = (set(part.tolist()) for part in (held_out[held_out < 60], held_out[held_out >= 60] - 60))
    assert len(first & second) > 0.7 * max(len(first), len(second))


def test_the_most_tilted_frames_of_a_stretch_are_left_out():
    poses = np.concatenate([freehand_poses(60, tilt_deg=tilt) for tilt in (-8.0, 0.0, 8.0)])
    sweep = sweep_at(poses)
    held_out = held_out_frames(sweep)
    middles = sweep.corners_mm().mean(axis=1)[:, 1]
    path = (middles - middles.min()) / np.ptp(middles)
    best = 0.0
    for along in (path, 1.0 - path):
        inside = (along > TURNED[0]) & (along < TURNED[1])
        tilts = np.arange(180)[inside] // 60
        left_out = np.isin(np.arange(180)[inside], held_out)
        shares = [left_out[tilts == tilt].mean() for tilt in (0, 2)]
        best = max(best, abs(shares[0] - shares[1]))
    assert best > 0.6


@pytest.mark.parametrize("count", [2, 3, 5, 8, 12])
def test_few_frames_are_left_enough_of(count):
    held_out = held_out_frames(sweep_at(straight(count)))
    assert count - len(held_out) >= min(count, LEAST_KEPT)
    assert len(held_out) <= MAX_SHARE * count
