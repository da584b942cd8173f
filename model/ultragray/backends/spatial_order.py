"""The order in which Gaussians that lie near each other come one after another."""

from __future__ import annotations

import torch
from torch import Tensor


def spatial_order(means: Tensor) -> Tensor:  # [N, 3] -> [N]
    """The Gaussians along a Morton curve: the kernels cull neighbours together and find them in the cache."""
    if not len(means):
        return torch.zeros(0, dtype=torch.int64, device=means.device)
    low, high = means.detach().amin(dim=0), means.detach().amax(dim=0)
    cells = (1023.0 * (means.detach() - low) / (high - low).clamp(min=1e-12)).long()
    keys = torch.zeros(len(means), dtype=torch.int64, device=means.device)
    for bit in range(10):
        for axis in range(3):
            keys |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return torch.argsort(keys, stable=True)
