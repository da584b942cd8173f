"""Confidence of frames as they are rendered: their support by Gaussians, and the expected error of each pixel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ultragray.geometry.probe import FloatArray, Probe
from ultragray.rendering.contact import Touch
from ultragray.rendering.settings import Below, Resolved
from ultragray.scene.confidence import (
    SUPPORT_COVERAGE,
    Assessor,
    DepthBands,
    Extrapolation,
    TrainingViews,
    is_confident,
    read_model,
)
from ultragray.scene.gaussians import GaussianScene


class SupportWatch:
    """The confidence in frames while they are rendered, in the order of their poses: their support and their contact
    with the skin, and the pixels that are masked for want of support.
    """

    def __init__(self, assessor: Assessor, extrapolations: Sequence[Extrapolation], settings: Resolved) -> None:
        """`extrapolations`: of all poses, from the poses alone."""
        limit = settings.min_confidence if settings.below_min_confidence is Below.MASK else None
        self._masked = [limit is not None and not is_confident(one, limit) for one in extrapolations]
        self._assessor, self._extrapolations = assessor, extrapolations
        self._shares: list[Tensor] = []
        self._contacts: list[FloatArray] = []
        self._count = 0

    def look(self, coverage: Tensor, touch: Touch | None = None) -> Tensor | None:  # [C, H, W] -> [C, H, W]
        """A mask of the pixels of the next C poses that are to be black; None where none are."""
        if touch is not None:
            self._contacts.append(touch.shares)
        masked = self._masked[self._count : self._count + len(coverage)]
        self._count += len(coverage)
        self._shares.append(_supported_shares(coverage))
        if not any(masked):
            return None
        return torch.tensor(masked, device=coverage.device)[:, None, None] & (coverage < SUPPORT_COVERAGE)

    def completed(self, first: int, stop: int) -> list[Extrapolation]:
        """The extrapolations of some frames with what was seen of them; waits for a GPU to have rendered."""
        shares = torch.cat(self._shares)[first:stop].tolist()
        found = self._assessor.with_support(self._extrapolations[first:stop], shares)
        if not self._contacts:
            return found
        contacts = np.concatenate(self._contacts)[first:stop].tolist()
        return [replace(one, contact_share=contact) for one, contact in zip(found, contacts, strict=True)]


def _supported_shares(coverage: Tensor) -> Tensor:  # [C, H, W] -> [C]
    if coverage.is_cuda:
        return (coverage >= SUPPORT_COVERAGE).flatten(1).float().mean(dim=1)
    supported = coverage.numpy() >= SUPPORT_COVERAGE  # numpy: torch's threads would fight with the kernel's
    return torch.tensor([np.count_nonzero(frame) / frame.size for frame in supported])


# The expected standard deviation of a pixel's error, from the planes rendered around it and the distances of views.
#
# All terms are computed in CELLS² cells of the image, over which B̄, γ and T are means, and then interpolated. i and
# d are `interpolation_mm` and `distance_mm` of `ViewMeasures`, on a grid of POINTS_PER_SIDE² points, interpolated
# too, and reach(x, r) = 1 − exp(−x/r). The terms vₖ:
#
#     floor      0.001                 level      B̄/10           level²   B̄²       texture   mean of B² less B̄²
#     gap r      reach(i, r)·V         beyond     reach(d, 5 mm)·V
#     thin       (1 − γ)·V             shadow     (1 − T)·B̄/10


CELLS = 32  # a side; no more than pixels
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
    terms = variance_terms(planes, view_distances(views, poses, probe), model.uncertainty.bands)
    weighted = [weight * term for weight, term in zip(model.uncertainty.variances, terms, strict=True)]
    deviation = torch.stack(weighted).sum(dim=0).clamp(0.0, 1.0).sqrt()
    return _interpolated(deviation, planes[0].shape[1:])


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
    bands: DepthBands,  # of the training images
) -> Iterator[Tensor]:  # each [C, h, w]
    """The vₖ in each cell, in the order of `uncertainty.TERMS`."""
    mean, coverage, transmittance = map(in_cells, planes)
    cells = mean.shape[1:]
    interpolation, distance = (
        _interpolated(torch.as_tensor(values, dtype=mean.dtype, device=mean.device), cells) for values in distances_mm
    )
    level, spread = (
        _interpolated(torch.tensor(values, dtype=mean.dtype, device=mean.device)[None, :, None], (cells[0], 1))
        for values in (bands.level, bands.spread)
    )
    unknown = spread + (level - mean).square()
    yield torch.full_like(mean, 1e-3)
    yield 0.1 * mean
    yield mean.square()
    yield (in_cells(planes[0].square()) - mean.square()).clamp_min(0.0)
    for reach in GAPS_MM:
        yield -torch.expm1(-interpolation / reach) * unknown
    yield -torch.expm1(-distance / BEYOND_MM) * unknown
    yield (1.0 - coverage) * unknown
    yield 0.1 * (1.0 - transmittance) * mean


def in_cells(frames: Tensor) -> Tensor:  # [C, H, W] -> [C, h, w]
    """Means over the cells."""
    height, width = frames.shape[1:]
    return functional.adaptive_avg_pool2d(frames, (min(CELLS, height), min(CELLS, width)))


def _interpolated(maps: Tensor, size: Sequence[int]) -> Tensor:  # [C, h, w] -> [C, *size]
    return functional.interpolate(maps[:, None], tuple(size), mode="bilinear", align_corners=False)[:, 0]
