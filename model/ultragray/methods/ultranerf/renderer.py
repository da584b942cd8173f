"""The renderer: what a beam keeps on its way along each scan line, and what it sends back from each sample.

Convention. Maps are [H, W]: row i is the i-th sample along scan line j, its column, from the face on. Products and sums
over j < i leave the sample itself out, so that the first one sees the whole beam. For any probe, the samples of a
frame are its pixels: range times angle for a fan.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

KERNEL_SIDE = 7  # pixels
KERNEL_SIGMAS = (1.0, 2.0)  # pixels, along depth and across scan lines


@dataclass(frozen=True, eq=False)
class Tissue:
    """What the field says of each sample."""

    attenuation: Tensor  # [H, W] α = |a|, per unit of length of the field's coordinates
    reflectance: Tensor  # [H, W] β = σ(b)
    border: Tensor  # [H, W] ρ_b = σ(p_b), the probability of a border
    scatterer: Tensor  # [H, W] ρ_s = σ(p_s), the probability of a scatterer
    amplitude: Tensor  # [H, W] φ = σ(s), of a scatterer

    @classmethod
    def of(cls, raw: Tensor) -> Tissue:  # [H, W, 5]
        a, *others = raw.unbind(-1)
        return cls(a.abs(), *(one.sigmoid() for one in others))


def expected_frame(tissue: Tissue, spacing: float) -> Tensor:  # -> [H, W]
    """The frame with each draw replaced by its probability, differentiable in all five maps.

    It is the mean over all draws for the scattering. For the reflection it is an approximation, as K reaches shallower
    borders that also weaken the beam. `spacing` is the distance between samples in the field's coordinates.
    """
    return _frame(tissue, tissue.border, tissue.scatterer, spacing)


def drawn_frame(tissue: Tissue, spacing: float, generator: torch.Generator) -> Tensor:  # -> [H, W]
    """The frame of one draw of borders and scatterers. Neither probability gets a gradient: draws are yes or no."""
    chances = torch.stack([tissue.border, tissue.scatterer]).detach()  # [2, H, W]
    uniform = torch.rand(chances.shape, generator=generator).to(chances)  # from the CPU: the same on every device
    border, scatterer = (uniform < chances).to(chances.dtype)
    return _frame(tissue, border, scatterer, spacing)


def transmission(tissue: Tissue, border: Tensor, spacing: float) -> Tensor:  # -> [H, W]
    """T = Π_{j<i} exp(−α_j Δ) · Π_{j<i} (1 − β_j G_j): what is left of the beam when it reaches a sample."""
    depth = _shifted(tissue.attenuation * spacing, 0.0).cumsum(0)
    passed = _shifted(1.0 - tissue.reflectance * border, 1.0).cumprod(0)
    return torch.exp(-depth) * passed


def point_spread(like: Tensor) -> Tensor:  # [7, 7]
    """K: a Gaussian whose sum is 1; its rows lie along depth, and it is wider across scan lines."""
    offsets = torch.arange(KERNEL_SIDE, dtype=like.dtype, device=like.device) - KERNEL_SIDE // 2
    along, across = (torch.softmax(-0.5 * (offsets / sigma).square(), dim=0) for sigma in KERNEL_SIGMAS)
    return torch.outer(along, across)


def _frame(tissue: Tissue, border: Tensor, scatterer: Tensor, spacing: float) -> Tensor:
    """I = T · β · (K * G) + T · (K * (H ⊙ φ)), not clipped."""
    sources = torch.stack([border, scatterer * tissue.amplitude])[:, None]  # [2, 1, H, W]
    spread = functional.conv2d(sources, point_spread(border)[None, None], padding=KERNEL_SIDE // 2)[:, 0]
    return transmission(tissue, border, spacing) * (tissue.reflectance * spread[0] + spread[1])


def _shifted(rows: Tensor, first: float) -> Tensor:  # [H, W] -> [H, W]
    """Each row one deeper, and a first row of one value; the last one, which nothing lies under, is left out."""
    return torch.cat([torch.full_like(rows[:1], first), rows[:-1]])
