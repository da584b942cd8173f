"""Octave encoding of points: the point itself, then the sine and cosine of each coordinate times 1, 2, 4 and so on."""

from __future__ import annotations

import torch
from torch import Tensor

OCTAVES = 10


def encoded_size(octaves: int = OCTAVES) -> int:
    """The numbers that a point becomes: 63 of ten octaves."""
    return 3 * (1 + 2 * octaves)


def encode(points: Tensor, octaves: int = OCTAVES) -> Tensor:  # [..., 3] -> [..., encoded_size]
    """p, sin p, cos p, sin 2p, cos 2p and so on to 2^(octaves - 1) p; no factor π (as released by Ultra-NeRF)."""
    angles = points[..., None, :] * torch.exp2(torch.arange(octaves, dtype=points.dtype, device=points.device))[:, None]
    waves = torch.stack([angles.sin(), angles.cos()], dim=-2)  # [..., K, 2, 3]
    return torch.cat([points, waves.flatten(start_dim=-3)], dim=-1)
