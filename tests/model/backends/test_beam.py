"""The elevational beam (docs/physics.md §3): its meaning, by the reference."""

import numpy as np
import pytest
import torch

from ultragray import ElevationBeam, render
from ultragray.errors import InvalidArgument
from ultragray.rendering.frames import footprint_pixels
from ultragray.rendering.outputs import WEIGHT_SUM

from .conftest import LINEAR, drawn

FOCUSED = ElevationBeam(thickness_mm=2.0, focus_mm=15.0, depth_of_field_mm=12.0)
CONSTANT = ElevationBeam(thickness_mm=3.0)


def shifted_along_elevation(pose, shift_mm):  # [4, 4], [K] -> [K, 4, 4]
    poses = np.repeat(pose[None], len(shift_mm), axis=0)
    poses[:, :3, 3] += shift_mm[:, None] * pose[:3, 1]
    return poses


def weight_sums(scene, poses, beam):  # [C, H, W]
    return drawn("reference", scene, LINEAR, poses, beam, outputs=(WEIGHT_SUM,))[WEIGHT_SUM]


def test_a_constant_beam_is_the_mean_of_thin_slices(random_scene, random_poses):
    scene = random_scene(4, seed=1, sigma_cm=(0.2, 0.6), dtype=torch.float64)
    (pose,) = random_poses(1, seed=2)
    nodes, weights = np.polynomial.hermite_e.hermegauss(31)
    sigma_mm = CONSTANT.thickness_mm / 2.3548
    slices = weight_sums(scene, shifted_along_elevation(pose, nodes * sigma_mm), None)
    mean = torch.einsum("k,khw->hw", torch.from_numpy(weights / weights.sum()), slices)
    thick = weight_sums(scene, pose[None], CONSTANT)[0]
    assert thick.max() > 0.2
    assert (thick - mean).abs().max() < 4 / 255  # of each Gaussian, weights below 1/255 may be left out


def test_a_beam_conserves_the_weight_that_lies_across_elevation(random_scene):
    scene = random_scene(4, seed=1, sigma_cm=(0.1, 0.3), dtype=torch.float64)
    across = np.linspace(-25.0, 25.0, 101)
    poses = shifted_along_elevation(np.eye(4), across)
    thin, thick = (weight_sums(scene, poses, beam).sum() for beam in (None, ElevationBeam(thickness_mm=4.0)))
    assert thick == pytest.approx(float(thin), rel=0.1)


def test_a_thickness_grows_by_the_square_root_of_two_within_half_the_depth_of_field():
    for offset in (-6.0, 6.0):
        assert FOCUSED.thickness_at_mm(15.0 + offset) == pytest.approx(2.0 * np.sqrt(2.0))
    assert CONSTANT.thickness_at_mm(40.0) == 3.0


def test_the_beam_of_the_scene_holds_unless_another_is_asked_for(random_scene):
    scene, thick = random_scene(100), random_scene(100, info={"beam": CONSTANT})

    def frame(scene, beam=None):
        return render(scene, LINEAR, np.eye(4), height=32, width=32, beam=beam).bmode

    assert torch.equal(frame(thick), frame(scene, CONSTANT))
    assert not torch.equal(frame(thick), frame(scene))
    assert torch.equal(frame(thick, ElevationBeam(thickness_mm=0.0)), frame(scene))


def test_a_thick_slice_cuts_more_gaussians_and_costs_more(random_scene):
    scene = random_scene(2000, sigma_cm=(0.02, 0.05))
    thin, thick = (
        footprint_pixels(scene, LINEAR, np.eye(4), height=64, width=64, beam=beam)[0] for beam in (None, CONSTANT)
    )
    assert thick > 2 * thin


@pytest.mark.parametrize(
    ("given", "missing"), [({"focus_mm": 10.0}, "depth_of_field_mm"), ({"depth_of_field_mm": 10.0}, "focus_mm")]
)
def test_a_focus_needs_a_depth_of_field(given, missing):
    with pytest.raises(InvalidArgument, match=f"{missing} must be given"):
        ElevationBeam(thickness_mm=1.0, **given)


def test_a_beam_of_another_shape_is_refused(random_scene):
    with pytest.raises(InvalidArgument, match=r"an ElevationBeam or a tensor \[3\]"):
        render(random_scene(2), LINEAR, np.eye(4), height=8, width=8, beam=torch.ones(2))
