"""sh0 and the intensity activations (docs/physics.md §2), as a training needs them.

The clamps of the activation `released` have no gradient beyond their ends: a Gaussian that once lies at the floor would
stay there. So after each step sh0 is put back between them (a projected gradient step). The gradient at the end itself
is the true one and leads back inside as soon as the images ask for it, which is what passing it straight through the
clamp aims at, with no gradient that `render()` does not give. Harmonics above degree 0 may still cross an end in some
views; in the others the Gaussian keeps its gradient.

`sigmoid` has no floor, so that a shadow can be learned as tissue without echo, which is wrong from any other angle. So
what lies in a shadow keeps a floor of its own for the first part of a training: what is above it learns to absorb.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

SH_C0 = 0.5 / math.sqrt(math.pi)  # the harmonic of degree 0
RELEASED_RANGE = (0.5 + 1e-3, 0.999 - 1e-3)  # of I, inside the clamps
SIGMOID_START_RANGE = (0.02, 0.98)  # nearer to 0 or 1 a Gaussian hardly moves


def sh0_of_intensity(brightness: Tensor, intensity: str) -> Tensor:  # [N] in [0, 1] -> [N]
    """The sh0 that gives this intensity, or the nearest one that still has a gradient."""
    if intensity == "sigmoid":
        value = torch.logit(brightness.clamp(*SIGMOID_START_RANGE)) / 4.0
    elif intensity == "released":
        value = brightness.clamp(*RELEASED_RANGE) - 1.0
    else:
        raise AssertionError(intensity)
    return value / SH_C0


def least_sh0(floor: Tensor, intensity: str) -> Tensor:  # [N] -> [N]
    """The sh0 at which the intensity is at its floor; −∞ where that is 0."""
    return torch.where(floor > 0.0, sh0_of_intensity(floor, intensity), -math.inf)


def project_sh0(sh0: Tensor, intensity: str, least: Tensor | None) -> None:  # [N, 1, 1], [N]
    """Puts sh0 back, in place, to where the activation has a gradient, and to at least `least`."""
    if intensity == "released":
        low, high = RELEASED_RANGE
        sh0.clamp_((low - 1.0) / SH_C0, (high - 1.0) / SH_C0)
    if least is not None:
        sh0.clamp_(min=least.reshape(sh0.shape))
