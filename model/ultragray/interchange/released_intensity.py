"""A `sigmoid` scene's echo intensities in the activation of the released code (docs/physics.md §2), as well as it can.

The released activation I = min(max(h + 1, 0.5), 0.999) knows no intensity under 0.5, `sigmoid` I = 1/(1 + exp(−4·h))
does. For each Gaussian the coefficients of h are fitted anew, at the scene's own degree, to what the released code can
show.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ultragray.backends.reference import spherical_harmonics
from ultragray.scene import GaussianScene

LOWEST, HIGHEST = 0.5, 0.999
MAX_TRAINING_VIEWS = 32
SPHERE_DIRECTIONS = 64
SPHERE_WEIGHT = 1e-3  # where poses say from where a Gaussian was seen; keeps the fit determined, and calm elsewhere
GAUSSIANS_PER_CHUNK = 8192


@dataclass(frozen=True)
class ReleasedIntensity:
    """Coefficients for the released activation, and how far the intensities they give are from the scene's own.

    Errors are over all Gaussians and the directions of the training views, or all directions where there are none.
    """

    sh0: Tensor  # [N, 1, 1]
    shN: Tensor  # [N, K-1, 1]  # noqa: N815 (the released name)
    largest_error: float
    mean_error: float


@torch.no_grad()
def fit_released_intensity(scene: GaussianScene) -> ReleasedIntensity:
    """Least squares over the directions from the training poses (at most 32 of them) to each Gaussian."""
    count, degree = scene.gaussian_count, scene.sh_degree
    coefficients = torch.cat([scene.sh0, scene.shN], dim=1)[..., 0].double()  # [N, K]
    fitted = torch.empty_like(coefficients)
    sphere = spherical_harmonics(_sphere_directions(), degree)  # [F, K]
    origins = _view_origins_cm(scene)  # [V, 3]
    largest, total, terms = 0.0, 0.0, 0
    for start in range(0, count, GAUSSIANS_PER_CHUNK):
        ids = slice(start, start + GAUSSIANS_PER_CHUNK)
        own = coefficients[ids]  # [n, K]
        offsets = scene.means[ids].double()[:, None] - origins  # [n, V, 3]
        seen = spherical_harmonics(torch.nn.functional.normalize(offsets, dim=-1), degree)  # [n, V, K]
        everywhere = sphere.expand(len(own), -1, -1)  # [n, F, K]
        basis = torch.cat([seen, everywhere], dim=1)
        weights = torch.ones(basis.shape[1], dtype=torch.float64)
        if len(origins):
            weights[len(origins) :] = SPHERE_WEIGHT * len(origins) / SPHERE_DIRECTIONS
        wanted = torch.sigmoid(4.0 * torch.einsum("nmk,nk->nm", basis, own))
        weighted = basis * weights[:, None]
        normal = torch.einsum("nmk,nml->nkl", weighted, basis)
        target = torch.einsum("nmk,nm->nk", weighted, wanted.clamp(LOWEST, HIGHEST) - 1.0)
        fitted[ids] = torch.linalg.solve(normal, target)
        compared = seen if len(origins) else everywhere
        shown = (torch.einsum("nmk,nk->nm", compared, fitted[ids]) + 1.0).clamp(LOWEST, HIGHEST)
        errors = (shown - wanted[:, : compared.shape[1]]).abs()
        largest = max(largest, float(errors.max()))
        total, terms = total + float(errors.sum()), terms + errors.numel()
    parameters = fitted.to(scene.sh0.dtype)[..., None]
    return ReleasedIntensity(parameters[:, :1], parameters[:, 1:], largest, total / max(terms, 1))


def _view_origins_cm(scene: GaussianScene) -> Tensor:  # [V, 3]
    """The probe's origin in evenly chosen training poses, in the scene's own frame."""
    poses = scene.poses_to_scene_cm(scene.training_poses)
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), MAX_TRAINING_VIEWS)).round().astype(int))
    return torch.from_numpy(poses[chosen, :3, 3])


def _sphere_directions() -> Tensor:  # [F, 3] unit
    """Evenly spread directions: a Fibonacci lattice."""
    index = torch.arange(SPHERE_DIRECTIONS, dtype=torch.float64)
    z = 1.0 - (2.0 * index + 1.0) / SPHERE_DIRECTIONS
    angle = math.pi * (1.0 + math.sqrt(5.0)) * index
    radius = torch.sqrt(1.0 - z.square())
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), z], dim=-1)
