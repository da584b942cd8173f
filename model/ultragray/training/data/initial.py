"""The Gaussians that a training starts from, as raw parameters (docs/physics.md §2), lengths in cm."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ...backends.spatial_order import spatial_order
from ...datasets.sweep import Dataset
from ...pose import quaternion_from_pose
from ...scene import PARAMETERS
from ...scene_info import expected_shapes
from ..config import TrainingConfig
from ..steps.intensity import sh0_of_intensity
from .geometry import Geometry

NO_ABSORPTION_LOGIT = 30.0  # τ = 1 to the last bit of a float32
RELEASED_INTENSITY = 0.6  # of the released start: sh0 = (0.1 − 0.5) / 0.28209
RELEASED_CUBE = 0.8  # half-side of the released start, × scene scale


def initial_parameters(
    dataset: Dataset, geometry: Geometry, config: TrainingConfig, generator: torch.Generator
) -> dict[str, Tensor]:
    """The six raw tensors, float32, in spatial order, drawn with `generator` alone; `config` leaves nothing open.

    `random` draws means uniformly in the released cube, round Gaussians of one intensity. `informed` draws pixels of
    the training frames uniformly and puts a Gaussian on each, turned like its frame and as thick as a slice, with
    that pixel's brightness as its intensity, off the plane by a normal deviate of half a frame spacing.
    """
    count = config.initial_gaussians
    assert count is not None
    assert config.initial_scale_mm is not None
    assert config.initial_elevation_mm is not None
    shapes = expected_shapes(count, config.sh_degree)
    quats = torch.zeros(shapes["quats"])
    quats[:, 0] = 1.0
    scales_mm = torch.full(shapes["scales"], config.initial_scale_mm)
    if config.start == "random":
        means = (2.0 * torch.rand((count, 3), generator=generator) - 1.0) * RELEASED_CUBE * geometry.scene_scale_cm
        brightness = torch.full((count,), RELEASED_INTENSITY)
    else:
        frame, means, brightness = _on_pixels(dataset, geometry, count, generator)
        turns = torch.tensor([quaternion_from_pose(pose) for pose in dataset.train.poses])
        quats = turns[frame]
        scales_mm[:, 1] = config.initial_elevation_mm
    logit = math.log(config.initial_transmittance / (1.0 - config.initial_transmittance))
    parameters = {
        "means": means,
        "scales": torch.log(scales_mm / 10.0),
        "quats": quats,
        "transmittances": torch.full(shapes["transmittances"], logit if config.transmittance else NO_ABSORPTION_LOGIT),
        "sh0": sh0_of_intensity(brightness, config.intensity).reshape(shapes["sh0"]),
        "shN": torch.zeros(shapes["shN"]),
    }
    order = spatial_order(means)
    return {name: parameters[name][order].contiguous() for name in PARAMETERS}


def _on_pixels(
    dataset: Dataset, geometry: Geometry, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:  # frames [N], means [N, 3] cm, brightness [N] in [0, 1]
    sweep, probe = dataset.train, dataset.probe
    frame = torch.randint(len(sweep), (count,), generator=generator)
    across, deep = torch.rand((2, count), generator=generator, dtype=torch.float64).numpy()  # share of the image
    elevation_mm = torch.randn(count, generator=generator, dtype=torch.float64).numpy() * geometry.frame_spacing_mm / 2
    points_mm = probe.points_mm(deep, across)
    points_mm[:, 1] = elevation_mm
    poses = sweep.poses[frame.numpy()]
    tracked_mm = np.einsum("nij,nj->ni", poses[:, :3, :3], points_mm) + poses[:, :3, 3]
    rows, columns = (deep * sweep.height).astype(np.int64), (across * sweep.width).astype(np.int64)
    brightness = sweep.images[frame.numpy(), rows, columns].astype(np.float32) / 255.0
    means = torch.from_numpy((tracked_mm - geometry.centre_mm) / 10.0).float()
    return frame, means, torch.from_numpy(brightness)
