"""Displaced tissue: Gaussians moved, turned and stretched by a smooth field u(x) before they are sliced.

A displacement takes a point x of the tissue at rest to x + u(x). A Gaussian of mean μ and covariance Σ becomes one of
mean μ + u(μ) and covariance F Σ Fᵀ, F = 1 + ∂u/∂x at μ; echo and transmittance stay its own. u is a sum of cubic
B-splines on a coarse grid, so that u, F and the derivative of F, which gradients need, are smooth and cheap, and bounds
of them follow from the coefficients: only Gaussians that may reach the image are displaced at all.

`scene.under(*displacements)` is the scene with its tissue displaced, by one field after another (the second one's x is
where the first one brought a point): every output, backend and gradient takes it from there. Whoever has a field of
another form (mechanics under a face, a vessel's wall) samples it at the nodes of a grid, in the axes of the scene or in
those of each pose, and hands the samples to `Displacement.through`:

    field = Displacement.through(samples_mm, origin_mm, spacing_mm, poses)   # samples [C, X, Y, Z, 3] along probe axes
    render(scene.under(*scene.displacements, field), probe, poses, …)

Gradients reach the samples. The grid must hold all that moves: beyond it a field goes on as at its border, which should
be at rest, or move as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ultragray.errors import InvalidArgument
from ultragray.geometry.probe import FloatArray

MAX_FIELDS = 4  # that displace a scene one after another, as in model/kernels/kernel.hpp
LEAST_SIDE = 4  # of a grid: as many splines overlap


@dataclass(frozen=True, eq=False)
class Displacement:
    """A field of cubic B-splines: the same for all poses of a call (C = 1), or another for each.

    Axis by axis, spline i of n is centred on grid coordinate i; between 1 and n − 2 four overlap, and the field goes on
    beyond as it is there. Raises InvalidArgument for other shapes.
    """

    coefficients: Tensor  # [C or 1, X, Y, Z, 3] mm, along the axes of the scene
    to_grid: FloatArray  # [C or 1, 3, 4]: grid coordinates of x, y, z, 1 in mm of the sweep's frame

    def __post_init__(self) -> None:
        shape = tuple(self.coefficients.shape)
        if len(shape) != 5 or shape[4] != 3 or min(shape[1:4]) < LEAST_SIDE or self.to_grid.shape[1:] != (3, 4):
            raise InvalidArgument(
                f"a displacement needs coefficients [C, X, Y, Z, 3], each side at least {LEAST_SIDE}, and maps to the "
                f"grid [C, 3, 4], got {list(shape)} and {list(self.to_grid.shape)}",
                field="displacements",
            )

    @classmethod
    def on_grid(cls, coefficients: Tensor, origin_mm: Any, spacing_mm: Any) -> Displacement:
        """Coefficients [C or 1, X, Y, Z, 3] on a grid along the axes of the scene, the first spline at `origin_mm`."""
        spacing = np.broadcast_to(np.asarray(spacing_mm, np.float64), 3)
        to_grid = np.concatenate([np.diag(1.0 / spacing), (-np.asarray(origin_mm) / spacing)[:, None]], axis=1)
        return cls(coefficients, to_grid[None])

    @classmethod
    def through(
        cls,
        samples: Tensor,  # [C or 1, X, Y, Z, 3] mm
        origin_mm: Any,  # [3], of the first sample
        spacing_mm: Any,  # [3] or one for all
        poses: FloatArray | None = None,  # [C, 4, 4] mm
    ) -> Displacement:
        """The field with these values at the nodes of a grid; with `poses`, grid and values are in the axes of each."""
        spacing = np.broadcast_to(np.asarray(spacing_mm, np.float64), 3)
        field = cls.on_grid(spline_coefficients(samples), np.asarray(origin_mm) - spacing, spacing)
        if poses is None:
            return field
        turns = torch.from_numpy(np.ascontiguousarray(poses[:, :3, :3])).to(samples)
        turned = torch.einsum("cij,cxyzj->cxyzi", turns, field.coefficients.expand(len(poses), -1, -1, -1, -1))
        into_pose = np.linalg.inv(poses)
        to_grid = field.to_grid[:, :, :3] @ into_pose[:, :3]
        to_grid[:, :, 3] += field.to_grid[0, :, 3]
        return cls(turned, to_grid)

    def of(self, poses: slice) -> Displacement:
        """That of some of the poses."""
        one_each = self.coefficients if len(self.coefficients) == 1 else self.coefficients[poses]
        return Displacement(one_each, self.to_grid if len(self.to_grid) == 1 else self.to_grid[poses])

    def in_cm(self, centre_mm: Sequence[float]) -> Displacement:
        """The same in cm about a scene's centre, as the reference takes it."""
        to_grid = 10.0 * self.to_grid
        to_grid[:, :, 3] = self.to_grid[:, :, 3] + self.to_grid[:, :, :3] @ np.asarray(centre_mm)
        return Displacement(self.coefficients / 10.0, to_grid)

    def at(self, points: Tensor, pose: int = 0) -> tuple[Tensor, Tensor]:  # [N, 3] -> [N, 3], [N, 3, 3]
        """u at points and its gradient, du_i/dx_j, in the unit of `to_grid`; differentiable to any order."""
        coefficients = self.coefficients[pose if len(self.coefficients) > 1 else 0].to(points)
        to_grid = torch.from_numpy(self.to_grid[pose if len(self.to_grid) > 1 else 0]).to(points)
        size = points.new_tensor(coefficients.shape[:3])
        grid = points @ to_grid[:, :3].T + to_grid[:, 3]
        places = torch.minimum(grid.clamp(min=1.0), size - 2)
        cell = torch.minimum(places.detach().floor(), size - 3)
        values, slopes = _splines(places - cell)  # [N, 3, 4] each
        slopes = slopes * (places == grid)[..., None]
        first = cell.long() - 1
        x, y, z = (first[:, axis, None] + torch.arange(4, device=points.device) for axis in range(3))
        taps = coefficients[x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]]  # [N, 4, 4, 4, 3]
        moved = torch.einsum("na,nb,nc,nabcd->nd", values[:, 0], values[:, 1], values[:, 2], taps)
        by_grid = [
            torch.einsum("na,nb,nc,nabcd->nd", *(slopes[:, k] if k == axis else values[:, k] for k in range(3)), taps)
            for axis in range(3)
        ]
        return moved, torch.stack(by_grid, dim=-1) @ to_grid[:, :3]


def displaced(means: Tensor, displacements: Sequence[Displacement], pose: int) -> tuple[Tensor, Tensor]:
    """Means [N, 3] after all displacements, and F [N, 3, 3], of one pose; in the unit of the displacements."""
    whole = torch.eye(3).to(means).expand(len(means), 3, 3)
    for displacement in displacements:
        moved, gradient = displacement.at(means, pose)
        means, whole = means + moved, whole + gradient @ whole
    return means, whole


def spline_coefficients(samples: Tensor) -> Tensor:  # [..., X, Y, Z, 3] -> [..., X + 2, Y + 2, Z + 2, 3]
    """Of the cubic splines through samples at grid coordinates 1, 2, …, which do not bend at the ends."""
    inverses = []
    for count in samples.shape[-4:-1]:
        equations = torch.zeros((count + 2, count + 2), dtype=torch.float64)
        for row in range(count):
            equations[row + 1, row : row + 3] = torch.tensor([1.0, 4.0, 1.0], dtype=torch.float64) / 6.0
        equations[0, :3] = equations[-1, -3:] = torch.tensor([1.0, -2.0, 1.0], dtype=torch.float64)
        inverses.append(torch.linalg.inv(equations)[:, 1:-1])
    return along_axes(samples, inverses)


def along_axes(values: Tensor, matrices: Sequence[Tensor]) -> Tensor:  # [..., X, Y, Z, 3] -> [..., X', Y', Z', 3]
    """The values multiplied by a matrix along each axis of a grid: [X', X], [Y', Y], [Z', Z]."""
    for axis, matrix in zip((-4, -3, -2), matrices, strict=True):
        values = torch.tensordot(values.movedim(axis, -1), matrix.to(values), dims=([-1], [1])).movedim(-1, axis)
    return values


def spline_basis(places: Tensor, count: int) -> Tensor:  # [S] grid coordinates from 1 to count - 2 -> [S, count]
    """What each of the splines of an axis is at some places."""
    cell = places.floor().clamp(max=count - 3)
    values, _ = _splines(places - cell)
    basis = places.new_zeros((len(places), count))
    return basis.scatter_(1, cell.long()[:, None] - 1 + torch.arange(4), values)


def _splines(t: Tensor) -> tuple[Tensor, Tensor]:  # [...] in [0, 1] -> [..., 4] both
    """The four cubic B-splines at a place within a cell, and their derivatives."""
    s = 1.0 - t
    values = (s**3 / 6, (t * t * (3 * t - 6) + 4) / 6, (s * s * (3 * s - 6) + 4) / 6, t**3 / 6)
    slopes = (-0.5 * s * s, t * (1.5 * t - 2), -s * (1.5 * s - 2), 0.5 * t * t)
    return torch.stack(values, dim=-1), torch.stack(slopes, dim=-1)
