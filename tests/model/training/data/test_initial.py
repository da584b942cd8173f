"""Where the Gaussians begin."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, Probe, SceneInfo
from ultragray.backends import reference
from ultragray.datasets.sweep import Dataset
from ultragray.training import TrainingConfig
from ultragray.training.data.geometry import Geometry
from ultragray.training.data.initial import initial_parameters
from ultragray.training.steps.refinement import rotate


def start_of(dataset: Dataset, config: TrainingConfig) -> dict[str, torch.Tensor]:
    geometry = Geometry.of(dataset)
    return initial_parameters(dataset, geometry, config.resolved(geometry), torch.Generator().manual_seed(3))


def test_informed_start_lies_on_pixels_of_that_brightness(
    tiny_dataset: Callable[..., Dataset], tiny_config: Callable[..., TrainingConfig], probe: Probe
) -> None:
    dataset = tiny_dataset(probe=probe, frames=9)
    images = np.repeat(dataset.train.images[:1], len(dataset.train), axis=0)  # so that y does not matter
    dataset = replace(dataset, train=replace(dataset.train, images=images))
    geometry = Geometry.of(dataset)
    parameters = start_of(dataset, tiny_config(max_gaussians=400))
    points_mm = parameters["means"].double().numpy() * 10.0 + geometry.centre_mm
    x, y, z = (points_mm - dataset.train.poses[0, :3, 3]).T
    if probe.kind == "linear":
        across, depth = x / probe.width_mm + 0.5, z  # type: ignore[union-attr]
    else:
        across = np.degrees(np.arctan2(x, z)) / probe.opening_angle_deg + 0.5  # type: ignore[union-attr]
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
    assert y.std() == pytest.approx(np.hypot(planes.std(), geometry.frame_spacing_mm / 2), rel=0.1)


def test_random_start_is_the_released_cube(
    tiny_dataset: Callable[..., Dataset], tiny_config: Callable[..., TrainingConfig]
) -> None:
    dataset = tiny_dataset()
    half_side = 0.8 * Geometry.of(dataset).scene_scale_cm
    config = TrainingConfig.preset("paper", max_gaussians=2000)
    parameters = start_of(dataset, config)
    assert parameters["means"].abs().max() <= half_side
    assert torch.allclose(parameters["means"].std(dim=0), torch.tensor(half_side / 3**0.5), rtol=0.1)
    assert torch.allclose(parameters["scales"], torch.tensor(math.log(0.05)))
    assert torch.allclose(parameters["sh0"], torch.tensor((0.1 - 0.5) / 0.28209), atol=1e-4)
    assert torch.allclose(torch.sigmoid(parameters["transmittances"]), torch.tensor(0.99))


def test_nothing_absorbs_without_transmittance(
    tiny_dataset: Callable[..., Dataset], tiny_config: Callable[..., TrainingConfig]
) -> None:
    parameters = start_of(tiny_dataset(), tiny_config(transmittance=False))
    assert bool((torch.sigmoid(parameters["transmittances"]) == 1.0).all())


def test_depends_on_the_generator_alone(
    tiny_dataset: Callable[..., Dataset], tiny_config: Callable[..., TrainingConfig]
) -> None:
    first, second = (start_of(tiny_dataset(), tiny_config()) for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_informed_gaussians_are_turned_like_their_frame_and_as_thick_as_a_slice(
    tiny_dataset: Callable[..., Dataset], tiny_config: Callable[..., TrainingConfig]
) -> None:
    dataset = tiny_dataset()
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    poses = dataset.train.poses.copy()
    poses[:, :3, :3] = turn
    dataset = replace(dataset, train=replace(dataset.train, poses=poses))
    parameters = start_of(dataset, tiny_config(initial_scale_mm=1.0, initial_elevation_mm=3.0))
    elevation = rotate(parameters["quats"], torch.tensor([[0.0, 1.0, 0.0]]).expand(len(parameters["quats"]), 3))
    assert torch.allclose(elevation, torch.tensor(turn[:, 1]).float(), atol=1e-6)
    assert torch.allclose(parameters["scales"].exp(), torch.tensor([0.1, 0.3, 0.1]))
