"""Gaussians as the demo scene's layers make them: in mm, with grey levels in place of spherical harmonics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..probe import FloatArray

Surface = Callable[[FloatArray, FloatArray], FloatArray]  # u [N], v [N], both in [0, 1] -> points [N, 3] mm

DYNAMIC_RANGE_DB = 45.0  # of the log compression that speckle has gone through
SH_CONSTANT = 0.28209479
SH_LINEAR = 0.48860251
DECIMALS = 5  # rounding hides the last bits in which two machines' exp and sin may differ


@dataclass(frozen=True)
class Splats:
    """N Gaussians, each a disc about its normal.

    A Gaussian's grey level goes from `facing`, where it is seen along its normal, to `edge_on`, where it is seen across it:
    that is how an interface that reflects like a mirror looks. Speckle has the same level from everywhere.
    """

    centres_mm: FloatArray  # [N, 3]
    sigmas_mm: FloatArray  # [N, 3] lateral, elevation, along the normal
    normals: FloatArray  # [N, 3] unit, pointing away from the probe (z >= 0)
    facing: FloatArray  # [N] in (0, 1)
    edge_on: FloatArray  # [N] in (0, 1)
    tau: FloatArray  # [N] transmittance in (0, 1)

    def __len__(self) -> int:
        return len(self.centres_mm)

    def where(self, kept: npt.NDArray[np.bool_]) -> Splats:  # [N]
        """The Gaussians that a mask chooses."""
        return Splats(**{f.name: getattr(self, f.name)[kept] for f in fields(self)})

    @classmethod
    def join(cls, *parts: Splats) -> Splats:
        """All Gaussians of several layers."""
        return cls(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)})


def splats(
    centres_mm: FloatArray,  # [N, 3]
    sigmas_mm: object,  # three numbers or [N, 3]
    *,
    facing: object,  # a number or [N]
    edge_on: object | None = None,  # as `facing` where not given
    tau: object,
    normals: FloatArray | None = None,  # [N, 3], the depth axis where not given
) -> Splats:
    """Splats from numbers or arrays. Normals are turned away from the probe."""
    count = len(centres_mm)
    if normals is None:
        normals = np.tile((0.0, 0.0, 1.0), (count, 1))
    else:
        normals = normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)

    def filled(value: object) -> FloatArray:
        return np.broadcast_to(np.asarray(value, dtype=np.float64), (count,)).copy()

    return Splats(
        centres_mm=centres_mm,
        sigmas_mm=np.broadcast_to(np.asarray(sigmas_mm, dtype=np.float64), (count, 3)).copy(),
        normals=normals,
        facing=filled(facing),
        edge_on=filled(facing if edge_on is None else edge_on),
        tau=filled(tau),
    )


def speckle_levels(rng: np.random.Generator, level: object, count: int) -> FloatArray:  # [N]
    """Grey levels of fully developed speckle about a tissue's own: log-compressed Rayleigh amplitudes."""
    power = -np.log1p(-rng.random(count))  # exponential, mean 1
    return np.clip(level + 10.0 * np.log10(power + 1e-3) / DYNAMIC_RANGE_DB, 0.01, 0.97)  # type: ignore[operator]


def scattered(
    rng: np.random.Generator, low_mm: tuple[float, ...], high_mm: tuple[float, ...], cell_mm: tuple[float, ...]
) -> FloatArray:  # [N, 3]
    """One point at random in each cell of a box: as irregular as speckle, without the holes of a uniform draw."""
    low, high = np.asarray(low_mm), np.asarray(high_mm)
    counts = np.maximum(1, np.round((high - low) / np.asarray(cell_mm))).astype(int)
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    return low + (cells + rng.random(cells.shape)) * ((high - low) / counts)


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
    return surface(u, v), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def parameters(gaussians: Splats, centre_mm: tuple[float, float, float]) -> dict[str, Tensor]:
    """Raw scene parameters (PHYSICS.md §2) for the `sigmoid` intensity, SH degree 1, in cm about `centre_mm`.

    sigmoid(4·(base + slope·cos)) is `edge_on` at cos = 0 and `facing` at cos = 1, cos between the view and the normal.
    """
    base = _logit(gaussians.edge_on) / 4.0
    slope = _logit(gaussians.facing) / 4.0 - base
    x, y, z = (gaussians.normals * slope[:, None] / SH_LINEAR).T
    nx, ny, nz = gaussians.normals.T
    quats = np.stack([1.0 + nz, -ny, nx, np.zeros(len(gaussians))], axis=1)  # shortest turn of z to the normal
    values = {
        "means": (gaussians.centres_mm - np.asarray(centre_mm)) / 10.0,
        "scales": np.log(gaussians.sigmas_mm / 10.0),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "transmittances": _logit(gaussians.tau),
        "sh0": (base / SH_CONSTANT)[:, None, None],
        "shN": np.stack([-y, z, -x], axis=1)[:, :, None],
    }
    return {name: torch.from_numpy(np.round(v, DECIMALS).astype(np.float32)) for name, v in values.items()}


def _logit(p: FloatArray) -> FloatArray:
    return np.log(p / (1.0 - p))
