"""From the sums over Gaussians to an image: the average with a background, and the shadow."""

from __future__ import annotations

import torch
from torch import Tensor


def average(
    weight_sum: Tensor,  # [C, H, W] Σ w
    intensity_sum: Tensor,  # [C, H, W] Σ c·w
    background_weight: Tensor,  # scalar, α_BG
    background_intensity: Tensor,  # scalar, c_BG
) -> Tensor:  # [C, H, W]
    """C = (Σ w c + α_BG c_BG) / (Σ w + α_BG)."""
    return (intensity_sum + background_weight * background_intensity) / (weight_sum + background_weight)


def shadow(weight_sum: Tensor, density: Tensor, row_cm: float) -> Tensor:  # [C, H, W], scalar 1/cm -> [C, H, W]
    """T(p) = exp(−κ·Σ w̄ δ) over the pixels of the scan line from the first down to p, p included; δ is row_cm.

    The first pixel of a scan line has T = exp(−κ·w̄·δ) of its own w̄, not 1.
    """
    return torch.exp(-density * row_cm * weight_sum.cumsum(dim=-2))
