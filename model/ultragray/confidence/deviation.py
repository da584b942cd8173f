"""The standard deviation that a pixel's error is expected to have, from what is rendered there and how far views are.

B̄ is B averaged over BLUR of the image's sides, i and d are `interpolation_mm` and `distance_mm` of `ViewMeasures`, on
a grid of POINTS_PER_SIDE² points, and reach(x, r) = 1 − exp(−x/r). The terms vₖ:

    floor      0.001                 level      B̄/10           level²   B̄²       texture   mean of B² less B̄²
    gap r      reach(i, r)·V         beyond     reach(d, 5 mm)·V
    thin       (1 − γ)·V             shadow     (1 − T)·B̄/10
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ..probe import FloatArray, Probe
from ..scene import GaussianScene
from .assess import read_model
from .uncertainty import DEPTHS, Uncertainty
from .views import TrainingViews

BLUR = 0.05  # of the height and of the width
POINTS_PER_SIDE = 12
GAPS_MM = (0.3, 1.0, 3.0)
BEYOND_MM = 5.0


def deviations(
    scene: GaussianScene,
    planes: tuple[Tensor, ...],  # bmode, coverage, transmittance, each [C, H, W]
    poses: FloatArray,  # [C, 4, 4] mm
    probe: Probe,
) -> Tensor:  # [C, H, W]
    """The output `uncertainty` of frames of a scene that has its model."""
    model = read_model(scene.info.confidence, len(scene.training_poses))
    assert model is not None
    assert model.uncertainty is not None
    views = TrainingViews(scene.training_poses, scene.info.probe_or(None))
    terms = variance_terms(planes, view_distances(views, poses, probe), model.uncertainty)
    variance = torch.zeros_like(planes[0])
    for weight, term in zip(model.uncertainty.variances, terms, strict=True):
        variance = variance + weight * term
    return variance.clamp(0.0, 1.0).sqrt()


def view_distances(
    views: TrainingViews, poses: FloatArray, probe: Probe
) -> tuple[FloatArray, FloatArray]:  # [C, 4, 4] mm -> two of [C, POINTS_PER_SIDE, POINTS_PER_SIDE]
    """Interpolation distance and distance to the views, mm, on a grid over each image."""
    measures = views.measure(poses, probe, POINTS_PER_SIDE)
    grid = (len(poses), POINTS_PER_SIDE, POINTS_PER_SIDE)
    return measures.interpolation_mm.reshape(grid), measures.distance_mm.reshape(grid)


def variance_terms(
    planes: tuple[Tensor, ...],  # bmode, coverage, transmittance, each [C, H, W]
    distances_mm: tuple[FloatArray, FloatArray],  # of `view_distances`
    images: Uncertainty,
) -> Iterator[Tensor]:  # each [C, H, W]
    """The vₖ, in the order of `uncertainty.TERMS`; of `images`, level and spread are looked at."""
    bmode, coverage, transmittance = planes
    height, width = bmode.shape[1:]
    interpolation, distance = (
        functional.interpolate(
            torch.as_tensor(values, dtype=bmode.dtype, device=bmode.device)[:, None], (height, width), mode="bilinear"
        )[:, 0]
        for values in distances_mm
    )
    level, spread = (_by_row(values, height, bmode) for values in (images.level, images.spread))
    mean = _blurred(bmode)
    unknown = spread + (level - mean).square()
    yield torch.full_like(bmode, 1e-3)
    yield 0.1 * mean
    yield mean.square()
    yield (_blurred(bmode.square()) - mean.square()).clamp_min(0.0)
    for reach in GAPS_MM:
        yield -torch.expm1(-interpolation / reach) * unknown
    yield -torch.expm1(-distance / BEYOND_MM) * unknown
    yield (1.0 - coverage) * unknown
    yield 0.1 * (1.0 - transmittance) * mean


def _by_row(bands: tuple[float, ...], height: int, like: Tensor) -> Tensor:  # [DEPTHS] -> [H, 1]
    rows = np.interp((np.arange(height) + 0.5) / height * DEPTHS - 0.5, np.arange(DEPTHS), bands)
    return torch.as_tensor(rows, dtype=like.dtype, device=like.device)[:, None]


def _blurred(frames: Tensor) -> Tensor:  # [C, H, W] -> [C, H, W]
    """Means over a window of BLUR of the sides; at the edges over what of it lies in the image."""
    rows, columns = (2 * round(0.5 * BLUR * side) + 1 for side in frames.shape[1:])
    for window in ((rows, 1), (1, columns)):
        padding = (window[0] // 2, window[1] // 2)
        frames = functional.avg_pool2d(frames[:, None], window, 1, padding, count_include_pad=False)[:, 0]
    return frames
