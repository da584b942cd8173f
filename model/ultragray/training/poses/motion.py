"""Rigid motions by six numbers: a turn and a shift."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...probe import FloatArray


def turn_vectors_deg(rotations: FloatArray) -> FloatArray:  # [F, 3, 3] -> [F, 3]
    """Axis times angle of rotations by less than 180°."""
    r = rotations
    twice = np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1)
    sine = np.linalg.norm(twice, axis=1) / 2.0
    angle = np.arctan2(sine, (np.trace(r, axis1=1, axis2=2) - 1.0) / 2.0)
    found: FloatArray = twice * np.degrees(angle / np.maximum(2.0 * sine, 1e-12))[:, None]
    return found


def rotations_of(turns_deg: FloatArray) -> FloatArray:  # [F, 3] -> [F, 3, 3]
    """Inverse of `turn_vectors_deg`."""
    turned: FloatArray = torch.linalg.matrix_exp(_cross_matrices(torch.from_numpy(np.radians(turns_deg)))).numpy()
    return turned


def motions_of(twists: Tensor) -> Tensor:  # [F, 6] turn in radians, shift -> [F, 4, 4]
    """The exponential of each twist; differentiable."""
    matrices = twists.new_zeros((len(twists), 4, 4))
    matrices[:, :3, :3] = _cross_matrices(twists[:, :3])
    matrices[:, :3, 3] = twists[:, 3:]
    motions: Tensor = torch.linalg.matrix_exp(matrices)
    return motions


def about(motions: FloatArray, points: FloatArray) -> FloatArray:  # [F, 4, 4], [F, 3] -> [F, 4, 4]
    """Motions that turn about points instead of the origin."""
    moved = motions.copy()
    moved[:, :3, 3] += points - np.einsum("fij,fj->fi", motions[:, :3, :3], points)
    return moved


def _cross_matrices(vectors: Tensor) -> Tensor:  # [F, 3] -> [F, 3, 3]
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(-1, 3, 3)
