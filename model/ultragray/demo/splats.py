"""Gaussians as the demo scene's layers make them: in mm, with grey levels in place of spherical harmonics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..probe import FloatArray

Scalars: TypeAlias = float | FloatArray  # one for all, or [N]
Surface: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]  # u [N], v [N], both in [0, 1] -> points [N, 3] mm

DYNAMIC_RANGE_DB = 45.0  # of the log compression that speckle has gone through
SH_CONSTANT = 0.28209479
SH_LINEAR = 0.48860251
DECIMALS = 5  # rounding hides the last bits in which two machines' exp and sin may differ


@dataclass(frozen=True)
class Splats:
    """N Gaussians, each a disc about its normal.

    The grey level goes from `facing`, seen along its normal, to `edge_on`, seen across it, as an
    interface does that reflects like a mirror. Speckle has the same level from everywhere.
    """

    centres_mm: FloatArray  # [N, 3]
    sigmas_mm: FloatArray  # [N, 3] lateral, elevation, along the normal
    normals: FloatArray  # [N, 3] unit, pointing away from the probe (z >= 0)
    facing: FloatArray  # [N] in (0, 1)
    edge_on: FloatArray  # [N] in (0, 1)
    tau: FloatArray  # [N] transmittance in (0, 1)

    def where(self, kept: npt.NDArray[np.bool_]) -> Splats:  # [N]
        """The Gaussians that a mask chooses."""
        return Splats(**{f.name: getattr(self, f.name)[kept] for f in fields(self)})

    @classmethod
    def of(
        cls,
        centres_mm: FloatArray,  # [N, 3]
        sigmas_mm: tuple[float, float, float] | FloatArray,  # [N, 3]
        *,
        facing: Scalars,
        edge_on: Scalars | None = None,  # as `facing` where not given
        tau: Scalars,
        normals: FloatArray | None = None,  # [N, 3], the depth axis where not given
    ) -> Splats:
        """Splats from one number for all or one for each; normals are turned away from the probe."""
        count = len(centres_mm)
        if normals is None:
            normals = np.tile((0.0, 0.0, 1.0), (count, 1))
        return cls(
            centres_mm=centres_mm,
            sigmas_mm=np.broadcast_to(sigmas_mm, (count, 3)),
            normals=normals * np.where(normals[:, 2:] < 0, -1.0, 1.0),
            facing=np.broadcast_to(facing, count),
            edge_on=np.broadcast_to(facing if edge_on is None else edge_on, count),
            tau=np.broadcast_to(tau, count),
        )

    @classmethod
    def join(cls, *parts: Splats) -> Splats:
        """All Gaussians of several layers."""
        return cls(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)})


def speckle_levels(rng: np.random.Generator, level: Scalars, count: int) -> FloatArray:  # [N]
    """Grey levels of fully developed speckle about a tissue's own: log-compressed Rayleigh amplitudes."""
    power = -np.log1p(-rng.random(count))  # exponential, mean 1
    return np.clip(level + 10.0 * np.log10(power + 1e-3) / DYNAMIC_RANGE_DB, 0.01, 0.97)


def scattered(
    rng: np.random.Generator,
    low_mm: tuple[float, ...],
    high_mm: tuple[float, ...],
    cell_mm: tuple[float, ...],
) -> FloatArray:  # [N, 3]
    """One point at random in each cell of a box: irregular, without the holes of a uniform draw."""
    low: FloatArray = np.asarray(low_mm)
    extent: FloatArray = np.asarray(high_mm) - low
    counts: npt.NDArray[np.int64] = np.maximum(1, np.round(extent / np.asarray(cell_mm))).astype(np.int64)
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    return low + (cells + rng.random(cells.shape)) * (extent / counts)


def spread_over(
    rng: np.random.Generator, surface: Surface, cells: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:  # [N, 3], [N, 3]
    """Points at random in the cells of a surface's parameters, and the surface's unit normals there."""
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in cells), indexing="ij"), axis=-1).reshape(-1, 2)
    u, v = ((grid + rng.random(grid.shape)) / np.asarray(cells)).T
    step = 1e-4
    across = surface(u + step, v) - surface(u - step, v)
    along = surface(u, v + step) - surface(u, v - step)
    normals = np.cross(across, along)
    return surface(u, v), normalised(normals)


def parameters(gaussians: Splats, centre_mm: tuple[float, float, float]) -> dict[str, Tensor]:
    """Raw scene parameters (docs/physics.md §2) for the `sigmoid` intensity, SH degree 1, in cm about `centre_mm`.

    sigmoid(4·(base + slope·cos)), cos that of the view to the normal, is `edge_on` at 0 and `facing` at 1.
    """
    base = _logit(gaussians.edge_on) / 4.0
    slope = _logit(gaussians.facing) / 4.0 - base
    x, y, z = (gaussians.normals * slope[:, None] / SH_LINEAR).T
    nx, ny, nz = gaussians.normals.T
    quats = np.stack([1.0 + nz, -ny, nx, np.zeros_like(nz)], axis=1)  # shortest turn of z to the normal
    values = {
        "means": (gaussians.centres_mm - np.asarray(centre_mm)) / 10.0,
        "scales": np.log(gaussians.sigmas_mm / 10.0),
        "quats": normalised(quats),
        "transmittances": _logit(gaussians.tau),
        "sh0": (base / SH_CONSTANT)[:, None, None],
        "shN": np.stack([-y, z, -x], axis=1)[:, :, None],
    }
    return {name: torch.from_numpy(np.round(v, DECIMALS).astype(np.float32)) for name, v in values.items()}


def normalised(vectors: FloatArray) -> FloatArray:  # [N, D]
    """The vectors at length 1."""
    lengths: FloatArray = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.maximum(lengths, 1e-12)


def _logit(p: FloatArray) -> FloatArray:
    return np.log(p / (1.0 - p))
