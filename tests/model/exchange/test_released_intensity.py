"""Sigmoid intensities in the released activation: exact where it can be, honest where it cannot."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import GaussianScene
from ultragray.exchange.checkpoint import fit_released_intensity
from ultragray.rendering.backends.reference import intensity


def fitted(scene):
    fit = fit_released_intensity(scene)
    splats = {**scene.splats, "sh0": fit.sh0, "shN": fit.shN}
    released = GaussianScene.from_splats(
        splats, info=replace(scene.info, intensity="released"), training_poses=scene.training_poses
    )
    return released, fit.largest_error, fit.mean_error


def errors(scene, released):  # [C, N]
    """What a renderer finds: the intensities of both, seen from each training pose."""
    origins = torch.from_numpy(scene.poses_to_scene_cm(scene.training_poses)[:, :3, 3]).float()
    return torch.stack([(intensity(scene, origin) - intensity(released, origin)).abs() for origin in origins])


@pytest.fixture
def make_scene(random_scene, random_poses):
    def make(sh_degree, *, sh0, spread, poses=6):
        made = random_scene(300, sh_degree=sh_degree, intensity="sigmoid", info={"centre_mm": (1.0, 2.0, 3.0)})
        rng = np.random.default_rng(5)
        splats = {
            **made.splats,
            "sh0": torch.from_numpy(rng.uniform(*sh0, (300, 1, 1)).astype(np.float32)),
            "shN": made.shN * spread,
        }
        return GaussianScene.from_splats(splats, info=made.info, training_poses=random_poses(poses))

    return make


def test_intensities_above_the_floor_fit_exactly_without_directions(make_scene):
    scene = make_scene(0, sh0=(0.1, 5.0), spread=1.0)  # I from 0.53 to 0.996
    released, largest, mean = fitted(scene)
    assert largest < 1e-6
    assert mean <= largest
    assert float(errors(scene, released).max()) < 1e-6


@pytest.mark.parametrize("sh_degree", [1, 2, 3])
def test_directions_fit_where_the_scene_was_seen_from(make_scene, sh_degree):
    scene = make_scene(sh_degree, sh0=(2.0, 3.0), spread=0.5)  # none under the floor
    released, largest, _ = fitted(scene)
    assert largest < 5e-3
    found = errors(scene, released)
    assert float(found.max()) == pytest.approx(largest, abs=1e-5)
    constant = replace_sh(released, 0.0)
    assert float(found.mean()) < 0.2 * float(errors(scene, constant).mean())


def replace_sh(scene, factor):
    return GaussianScene.from_splats({**scene.splats, "shN": scene.shN * factor}, info=scene.info)


def test_what_lies_under_the_floor_is_told(make_scene):
    scene = make_scene(1, sh0=(-5.0, -3.0), spread=0.0)  # I from 0.0035 to 0.033
    released, largest, mean = fitted(scene)
    found = errors(scene, released)
    assert largest == pytest.approx(float(found.max()), abs=1e-5)
    assert mean == pytest.approx(float(found.mean()), abs=1e-5)
    assert 0.46 < mean <= largest < 0.5


def test_without_training_poses_all_directions_count(make_scene):
    scene = make_scene(1, sh0=(1.0, 2.0), spread=0.3, poses=0)
    _, largest, mean = fitted(scene)
    assert 0.0 < mean < largest < 0.05


def test_no_gaussians(random_scene):
    fit = fit_released_intensity(random_scene(0, intensity="sigmoid"))
    assert (fit.largest_error, fit.mean_error, fit.shN.shape) == (0.0, 0.0, (0, 3, 1))
