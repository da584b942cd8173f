"""Modes of motion that are learned from frames."""

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe, render
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.learn.motion import find_motion, fit_motion, numbers_of, read_numbers
from ultragray.learn.sweep import Sweep
from ultragray.scene.info import SceneInfo

PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)


@pytest.fixture
def phantom(random_scene):
    still = random_scene(400, seed=4, extent_cm=(3.0, 1.0, 4.0), centre_cm=(0.0, 0.0, 2.0), sigma_cm=(0.08, 0.2))
    return GaussianScene.from_splats(still.splats, info=SceneInfo(probe=PROBE))


NUMBERS = np.tile([11.5, 12.0, 11.5, 10.5, 10.0, 10.5], 2)


@pytest.fixture
def sweep(phantom):
    """Frames of tissue that goes 1.5 mm deeper for each unit."""
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, 1, 3] = np.linspace(-2.0, 2.0, 12)
    seen = poses.copy()
    seen[:, 2, 3] -= 1.5 * (NUMBERS - 11.0)
    frames = render(phantom, PROBE, seen, height=40, width=30).bmode
    return Sweep((255.0 * frames).byte().numpy(), poses, PROBE, np.arange(12), "phantom")


def test_a_shift_is_learned_from_frames_with_a_number_each(phantom, sweep):
    torch.manual_seed(0)
    moving = fit_motion(phantom, sweep, NUMBERS, surrogate="belt", steps=80, spacing_mm=20.0)
    (mode,) = moving.info.motion.modes
    assert (mode.low, mode.high, mode.rest, mode.surrogate) == (10.0, 12.0, 11.0, "belt")
    middle = torch.tensor([[0.0, 0.0, 20.0]])
    shift = moving.at_phase((12.0,)).displacements[0].at(middle)[0][0] - torch.tensor([0.0, 0.0, 1.5])
    assert shift[[0, 2]].abs().max() < 0.4, shift
    with pytest.raises(InvalidArgument, match="and differ"):
        fit_motion(phantom, sweep, np.ones(12))


def test_numbers_that_nobody_told_are_found_with_the_field(phantom, sweep):
    moving, found = find_motion(phantom, sweep, steps=160, spacing_mm=20.0)
    assert np.corrcoef(found, NUMBERS)[0, 1] > 0.98, found
    assert (found.min(), found.max()) == (0.0, 1.0)
    (mode,) = moving.info.motion.modes
    assert 0.2 < mode.rest < 0.8
    middle = torch.tensor([[0.0, 0.0, 20.0]])
    shift = moving.at_phase((1.0,)).displacements[0].at(middle)[0][0]
    shift -= 0.0 if mode.rest == 0.0 else moving.at_phase((0.0,)).displacements[0].at(middle)[0][0]
    assert abs(float(shift[2]) - 3.0) < 0.6, shift


def test_numbers_that_are_none_or_too_few_are_refused(phantom, tmp_path):
    images = np.random.default_rng(0).integers(0, 255, (2, 12, 12), np.uint8)
    sweep = Sweep(images, np.tile(np.eye(4), (2, 1, 1)), PROBE, np.array([0, 2]), "phantom")
    path = tmp_path / "belt.csv"
    path.write_text("1.0\n2.0\n3.0\n")
    assert numbers_of(sweep, read_numbers(path), "belt.csv").tolist() == [1.0, 3.0]
    path.write_text("1.0\n2.0\n")
    with pytest.raises(DatasetInvalid, match="each of 3 frames, got \\[2\\]"):
        numbers_of(sweep, read_numbers(path), "belt.csv")
    path.write_text("1.0\nbreath\n")
    with pytest.raises(DatasetInvalid, match=r"belt\.csv"):
        read_numbers(path)
