"""Batches go round the frames; poses are shifted along their own elevation."""

from collections import Counter

import numpy as np
import pytest
import torch

from ultragray import LinearProbe
from ultragray.learn.sweep import Sweep
from ultragray.learn.training.geometry import (
    BatchSampler,
    out_of_plane_range_mm,
    out_of_plane_shift_mm,
    shift_out_of_plane,
)


def test_every_frame_is_seen_equally_often():
    sampler = BatchSampler(10, 4, torch.Generator().manual_seed(0))
    batches = [sampler.next_batch() for _ in range(5)]
    assert [len(batch) for batch in batches] == [4] * 5
    assert Counter(torch.cat(batches).tolist()) == dict.fromkeys(range(10), 2)
    assert torch.cat(batches[:2]).tolist() != sorted(torch.cat(batches[:2]).tolist())


def test_batch_holds_each_frame_once_at_most():
    assert sorted(BatchSampler(3, 8, torch.Generator()).next_batch().tolist()) == [0, 1, 2]


def test_shifts_follow_the_squared_cosine():
    generator = torch.Generator().manual_seed(0)
    shifts = np.array([out_of_plane_shift_mm(2.0, generator) for _ in range(4000)])
    assert np.abs(shifts).max() <= 1.0
    assert abs(shifts.mean()) < 0.03
    # The density 2·cos²(πx) on [−½, ½] has the variance 1/12 − 1/(2π²); the full range is 2 mm.
    assert shifts.std() == pytest.approx(2.0 * (1 / 12 - 1 / (2 * np.pi**2)) ** 0.5, rel=0.05)


def test_shift_is_along_elevation(random_poses):
    poses = random_poses(4)
    shifted = shift_out_of_plane(poses, 1.5)
    in_probe = np.einsum("cji,cj->ci", poses[:, :3, :3], shifted[:, :3, 3] - poses[:, :3, 3])
    assert np.allclose(in_probe, (0.0, 1.5, 0.0))
    assert np.array_equal(shifted[:, :3, :3], poses[:, :3, :3])


@pytest.mark.parametrize("blur_mm", [4.0, 8.0])
def test_out_of_plane_range_follows_the_blur_of_the_frames(blur_mm):
    """Noisy slices through a field that is smooth over `blur_mm`: noise widens the range, detail narrows it."""
    rng = np.random.default_rng(5)
    y = 0.5 * np.arange(80)
    phases, rates = rng.uniform(0, 2 * np.pi, 400), 2 * np.pi / (blur_mm * rng.uniform(2.0, 4.0, 400))
    images = 128 + 40 * np.sin(np.outer(y, rates) + phases) + rng.normal(0.0, 20.0, (80, 400))
    poses = np.tile(np.eye(4), (80, 1, 1))
    poses[:, 1, 3] = y
    frames = np.clip(images, 0, 255).astype(np.uint8).reshape(80, 20, 20)
    sweep = Sweep(frames, poses, LinearProbe(20.0, 0.0, 20.0), np.arange(80), "waves")
    assert blur_mm / 4 <= out_of_plane_range_mm(sweep) <= 0.75 * blur_mm


def test_frames_far_apart_tell_no_out_of_plane_range(tiny_dataset):
    assert out_of_plane_range_mm(tiny_dataset(spacing_mm=30.0).train) == 0.0
    still = tiny_dataset(spacing_mm=0.0).train
    assert out_of_plane_range_mm(still) == 0.0


@pytest.mark.parametrize(("frames", "spacing_mm"), [(3, 10.0), (6, 5.0), (12, 3.0), (20, 1.5), (3, 80.0)])
def test_out_of_plane_range_does_not_run_away_where_speckle_tells_nothing(frames, spacing_mm):
    """Frames of pure speckle are best predicted by the mean of them all, however far they lie apart."""
    speckle = np.random.default_rng(2).rayleigh(40.0, (frames, 20, 20)).clip(0, 255).astype(np.uint8)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 1, 3] = spacing_mm * np.arange(frames)
    sweep = Sweep(speckle, poses, LinearProbe(20.0, 0.0, 20.0), np.arange(frames), "speckle")
    assert out_of_plane_range_mm(sweep) <= 8.0
