"""The Gaussians that a fit starts from: raw parameters (docs/physics.md §2), in cm about the scene's centre."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ultragray.backends.spatial_order import spatial_order
from ultragray.datasets.sweep import Dataset
from ultragray.methods.parts.space import Box
from ultragray.probe import FloatArray
from ultragray.probe.scan_lines import ParallelLines
from ultragray.training.data.geometry import Geometry

START_LOGIT = 1.0  # α = σ(1) = 0.731
LOW, HIGH = 4.0, 5.0  # of the entries of L, in the normalised volume
LEAST_PRECISION = 1e-6  # β, likewise


def wide_start(dataset: Dataset, count: int, generator: torch.Generator) -> dict[str, Tensor]:
    """The author's: each Gaussian of the precision L·Lᵀ + β·1, all entries of the lower triangle L uniform in [4, 5).

    The normalised volume is the cube of side 2 around the corners of the training frames.
    """
    lower = (LOW + (HIGH - LOW) * torch.rand((count, 3, 3), generator=generator, dtype=torch.float64)).tril()
    precision = lower @ lower.transpose(1, 2) + LEAST_PRECISION * torch.eye(3, dtype=torch.float64)
    values, axes = torch.linalg.eigh(precision)  # [N, 3], [N, 3, 3] with the axes as columns
    axes[:, :, 0] *= torch.linalg.det(axes)[:, None]  # no mirror
    unit_cm = Box.of(dataset.train).largest_half_mm / 10.0
    points_mm, _ = _points(dataset, count, generator)
    return _start(dataset, points_mm, (unit_cm * values.rsqrt()).log(), _quaternions(axes))


def even_start(dataset: Dataset, count: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Gaussians whose standard deviation is the side of the cube that each has to itself: (volume / N)^(1/3).

    Across the frames, along elevation, it is at least half the spacing of the frames: else there would be Gaussians
    between them that no frame trains, and a plane in a gap would show those.
    """
    points_mm, rotations = _points(dataset, count, generator)
    side_mm = (_volume_mm3(dataset) / count) ** (1 / 3)
    deviations_mm = torch.tensor([side_mm, max(side_mm, _thickness_mm(dataset) / 2.0), side_mm], dtype=torch.float64)
    return _start(
        dataset, points_mm, (deviations_mm / 10.0).log().expand(count, 3), _quaternions(torch.from_numpy(rotations))
    )


def _start(dataset: Dataset, points_mm: FloatArray, scales: Tensor, quats: Tensor) -> dict[str, Tensor]:
    means = torch.from_numpy(points_mm - dataset.centre_mm) / 10.0
    parameters = {
        "means": means,
        "scales": scales,
        "quats": quats,
        "transmittances": torch.full((len(scales),), START_LOGIT),
        "sh0": torch.zeros((len(scales), 1, 1)),  # c = 0.5
    }
    order = spatial_order(means)
    return {name: tensor[order].float().contiguous() for name, tensor in parameters.items()}


def _thickness_mm(dataset: Dataset) -> float:
    """By which a frame stands for the space around its plane."""
    geometry = Geometry.of(dataset)
    return geometry.frame_spacing_mm or geometry.pixel_mm


def _volume_mm3(dataset: Dataset) -> float:
    """Of the space that the frames acquire, each as thick as their spacing."""
    probe = dataset.probe
    breadth_mm = (probe.lines.breadth_mm(probe.near_mm) + probe.lines.breadth_mm(probe.far_mm)) / 2.0
    return len(dataset.train) * _thickness_mm(dataset) * probe.scan_line_length_mm * breadth_mm


def _points(
    dataset: Dataset, count: int, generator: torch.Generator
) -> tuple[FloatArray, FloatArray]:  # [N, 3] mm in the tracker's frame, [N, 3, 3]
    """Points drawn uniformly in that space, and the axes of the frame that each lies at."""
    sweep, probe = dataset.train, dataset.probe
    frames = torch.randint(len(sweep), (count,), generator=generator).numpy()
    deep, across, beside = torch.rand((3, count), generator=generator, dtype=torch.float64).numpy()
    if not isinstance(probe.lines, ParallelLines):  # lines that fan out: as many more points as they are further apart
        near, far = probe.near_mm, probe.far_mm
        deep = (np.sqrt(near**2 + deep * (far**2 - near**2)) - near) / (far - near)
    points = probe.points_mm(deep, across)
    points[:, 1] += (beside - 0.5) * _thickness_mm(dataset)
    poses = sweep.poses[frames]
    return np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3], poses[:, :3, :3]


def _quaternions(axes: Tensor) -> Tensor:  # [N, 3, 3] rotations -> [N, 4] wxyz
    """By the largest of the four components, so that no digits are lost."""
    xx, yy, zz = axes.diagonal(dim1=1, dim2=2).unbind(-1)
    x = axes[:, 2, 1] - axes[:, 1, 2]
    y = axes[:, 0, 2] - axes[:, 2, 0]
    z = axes[:, 1, 0] - axes[:, 0, 1]
    xy, xz, yz = axes[:, 0, 1] + axes[:, 1, 0], axes[:, 0, 2] + axes[:, 2, 0], axes[:, 1, 2] + axes[:, 2, 1]
    products = torch.stack(  # 4·q_a·q_b
        [
            torch.stack([1 + xx + yy + zz, x, y, z], dim=-1),
            torch.stack([x, 1 + xx - yy - zz, xy, xz], dim=-1),
            torch.stack([y, xy, 1 - xx + yy - zz, yz], dim=-1),
            torch.stack([z, xz, yz, 1 - xx - yy + zz], dim=-1),
        ],
        dim=1,
    )
    largest = products.diagonal(dim1=1, dim2=2).argmax(dim=-1)
    return torch.nn.functional.normalize(products[torch.arange(len(axes)), largest], dim=-1)
