"""Where the Gaussians begin, and sh0 for an intensity."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, SceneInfo
from ultragray.learn.training import TrainingConfig
from ultragray.learn.training.between import neighbours_of
from ultragray.learn.training.geometry import Geometry, Shadows
from ultragray.learn.training.initial import initial_parameters
from ultragray.learn.training.intensity import project_sh0, sh0_of_intensity
from ultragray.learn.training.optimizer import rotate
from ultragray.rendering.backends import reference
from ultragray.scene.info import expected_shapes


def whole_start_of(dataset, config):
    geometry, neighbours = Geometry.of(dataset), neighbours_of(dataset.train)
    shadows = Shadows(dataset.train) if config.transmittance else None
    generator = torch.Generator().manual_seed(3)
    return initial_parameters(dataset, neighbours, shadows, geometry, config.resolved(geometry), generator)


def start_of(dataset, config):
    return whole_start_of(dataset, config).parameters


def test_informed_start_lies_on_pixels_of_that_brightness(tiny_dataset, tiny_config, probe):
    dataset = tiny_dataset(probe=probe, frames=9)
    images = np.repeat(dataset.train.images[:1], len(dataset.train), axis=0)  # so that y does not matter
    dataset = replace(dataset, train=replace(dataset.train, images=images))
    geometry = Geometry.of(dataset)
    parameters = start_of(dataset, tiny_config(max_gaussians=400, transmittance=False))
    points_mm = parameters["means"].double().numpy() * 10.0 + geometry.centre_mm
    x, y, z = (points_mm - dataset.train.poses[0, :3, 3]).T
    if probe.kind == "linear":
        across, depth = x / probe.width_mm + 0.5, z
    else:
        across = np.degrees(np.arctan2(x, z)) / probe.opening_angle_deg + 0.5
        depth = np.hypot(x, z)
    row = (depth - probe.near_mm) / probe.scan_line_length_mm * dataset.train.height
    column = across * dataset.train.width
    inside = (np.abs(row - np.round(row)) > 1e-3) & (np.abs(column - np.round(column)) > 1e-3)  # float32 means
    pixels = images[0, row.astype(int), column.astype(int)] / 255.0
    scene = GaussianScene.from_splats(parameters, info=SceneInfo(intensity="sigmoid"))
    intensity = reference.intensity(scene, torch.zeros(3)).double().numpy()
    assert inside.mean() > 0.95
    assert np.abs(intensity - pixels)[inside].max() < 1e-5
    planes = dataset.train.poses[:, 1, 3] - dataset.train.poses[0, 1, 3]
    extent_mm = neighbours_of(dataset.train).extent_mm
    assert planes.min() - extent_mm <= y.min() < planes.min()
    assert planes.max() < y.max() <= planes.max() + extent_mm
    shares, _ = np.histogram(y, planes)
    shares = shares / np.diff(planes)
    assert shares.min() > 0.6 * shares.mean(), "no gap stays empty"


def test_random_start_is_the_released_cube(tiny_dataset, tiny_config):
    dataset = tiny_dataset()
    half_side = 0.8 * Geometry.of(dataset).scene_scale_cm
    config = TrainingConfig.preset("paper", max_gaussians=8000)
    parameters = start_of(dataset, config)
    assert parameters["means"].abs().max() <= half_side
    assert torch.allclose(parameters["means"].std(dim=0), torch.tensor(half_side / 3**0.5), rtol=0.1)
    assert torch.allclose(parameters["scales"], torch.tensor(math.log(0.05)))
    assert torch.allclose(parameters["sh0"], torch.tensor((0.1 - 0.5) / 0.28209), atol=1e-4)
    assert torch.allclose(torch.sigmoid(parameters["transmittances"]), torch.tensor(0.99))


def test_informed_gaussians_are_turned_like_their_frame_and_as_thick_as_a_slice(tiny_dataset, tiny_config):
    dataset = tiny_dataset()
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    poses = dataset.train.poses.copy()
    poses[:, :3, :3] = turn
    dataset = replace(dataset, train=replace(dataset.train, poses=poses))
    parameters = start_of(dataset, tiny_config(initial_scale_mm=1.0, initial_elevation_mm=4.0))
    elevation = rotate(parameters["quats"], torch.tensor([[0.0, 1.0, 0.0]]).expand(len(parameters["quats"]), 3))
    assert torch.allclose(elevation, torch.tensor(turn[:, 1]).float(), atol=1e-6)
    assert torch.allclose(parameters["scales"].exp(), torch.tensor([0.1, 0.4, 0.1]))


def test_gaussians_beyond_an_end_are_the_thicker_the_farther_they_lie(tiny_dataset, tiny_config):
    dataset = tiny_dataset()
    parameters = start_of(dataset, tiny_config(max_gaussians=500, initial_elevation_mm=0.3))
    y = parameters["means"][:, 1].double().numpy() * 10.0 + Geometry.of(dataset).centre_mm[1]
    planes = dataset.train.poses[:, 1, 3]
    beyond_mm = np.maximum(np.maximum(planes.min() - y, y - planes.max()), 0.0)
    thickness_mm = parameters["scales"][:, 1].exp().numpy() * 10.0
    assert np.allclose(
        thickness_mm, np.clip(0.5 * beyond_mm, 0.3, 0.9 * Geometry.of(dataset).scene_scale_cm), rtol=1e-3
    )
    assert (beyond_mm > 1.0).sum() > 20


def test_what_lies_in_a_shadow_begins_as_bright_as_beside_it_and_keeps_a_floor(tiny_dataset, tiny_config):
    dataset = tiny_dataset(height=60, width=40)
    images = np.full_like(dataset.train.images, 100)
    images[:, 20:, 10:16] = 3  # a shadow below something of the usual brightness
    images[:, 20:30, 30:36] = 3  # a vessel: the beam goes on
    images[:, 0, 0] = 101
    dataset = replace(dataset, train=replace(dataset.train, images=images))
    start = whole_start_of(dataset, tiny_config(max_gaussians=8000))
    x, _, z = (start.parameters["means"].double().numpy() * 10.0 + Geometry.of(dataset).centre_mm).T - [
        [30.0],
        [0.0],
        [10.0],
    ]
    row, column = (z / 25.0 * 60).astype(int), ((x / 20.0 + 0.5) * 40).astype(int)
    scene = GaussianScene.from_splats(start.parameters, info=SceneInfo(intensity="sigmoid"))
    intensity = reference.intensity(scene, torch.zeros(3))
    shadowed = (row > 30) & (row < 45) & (column > 11) & (column < 14)
    vessel = (row > 22) & (row < 27) & (column > 31) & (column < 34)
    assert shadowed.sum() > 10
    assert vessel.sum() > 5
    assert intensity[shadowed].numpy() == pytest.approx(100 / 255, abs=0.05)
    assert start.floor[shadowed].numpy() == pytest.approx(0.9 * 100 / 255, abs=0.05)
    assert float(intensity[vessel].max()) < 0.05
    assert float(start.floor[~shadowed & (column > 20)].max()) == 0.0
    assert float(whole_start_of(dataset, tiny_config(transmittance=False)).floor.max()) == 0.0


def intensity_of(sh0, name):
    splats = {key: torch.ones(shape) for key, shape in expected_shapes(len(sh0), 0).items()}
    scene = GaussianScene.from_splats({**splats, "sh0": sh0.reshape(-1, 1, 1)}, info=SceneInfo(intensity=name))
    return reference.intensity(scene, torch.zeros(3))


@pytest.mark.parametrize(("name", "low", "high"), [("released", 0.501, 0.998), ("sigmoid", 0.02, 0.98)])
def test_gives_the_intensity(name, low, high):
    wanted = torch.linspace(0.0, 1.0, 11)
    assert torch.allclose(intensity_of(sh0_of_intensity(wanted, name), name), wanted.clamp(low, high), atol=1e-6)


def test_released_gaussian_beyond_an_end_has_a_gradient_again():
    sh0 = torch.tensor([-5.0, 5.0]).reshape(2, 1, 1)
    project_sh0(sh0, "released", None)
    sh0.requires_grad_()
    intensity_of(sh0, "released").sum().backward()
    assert sh0.grad is not None
    assert bool((sh0.grad > 0.28).all())


def test_sigmoid_is_left_alone():
    sh0 = torch.tensor([-50.0, 50.0]).reshape(2, 1, 1)
    project_sh0(sh0, "sigmoid", torch.zeros(2))
    assert sh0.flatten().tolist() == [-50.0, 50.0]


@pytest.mark.parametrize("name", ["released", "sigmoid"])
def test_a_floor_is_the_least_intensity(name):
    sh0 = torch.tensor([-5.0, 0.5, -0.4]).reshape(3, 1, 1)
    free = sh0.clone()
    project_sh0(free, name, None)
    project_sh0(sh0, name, torch.tensor([0.6, 0.6, 0.0]))
    assert intensity_of(sh0, name)[0].item() == pytest.approx(0.6)
    assert torch.equal(sh0[1:], free[1:])
