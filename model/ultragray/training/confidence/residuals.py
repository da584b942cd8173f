"""The fit of a scene's uncertainty: the variances that explain the errors of frames that a training did not see."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch

from ultragray.confidence.deviation import POINTS_PER_SIDE as DEVIATION_POINTS
from ultragray.confidence.deviation import CELLS, in_cells, variance_terms, view_distances
from ultragray.confidence.uncertainty import DEPTHS, DepthBands, Uncertainty
from ultragray.confidence.views import FAR_MM, TrainingViews
from ultragray.datasets.sweep import ByteArray, Sweep
from ultragray.evaluation.scoring import frames_at_once
from ultragray.probe import FloatArray
from ultragray.rendering import render
from ultragray.scene import GaussianScene

LOOKED_AT = 40_000  # cells, over all frames
FAR_SHARE = 0.05  # of the weight of those cells: weight of places far from all views, where no frame shows the error
ITERATIONS = 300


def fit_uncertainty(scene: GaussianScene, views: TrainingViews, sweep: Sweep, *, backend: str) -> Uncertainty:
    """The variances that make the errors of the scene on the frames of a sweep likeliest.

    `views` are those that the scene was trained from. Far from them no errors are known, and there the variance is
    to be that of the training images.
    """
    bands = _bands(sweep.images)
    stride = max(1, len(sweep) * CELLS**2 // LOOKED_AT) | 1  # odd, while CELLS is even: cells of every column are taken
    terms, squares = [], []
    portion = frames_at_once(sweep.height, sweep.width)
    with torch.no_grad():
        for first in range(0, len(sweep), portion):
            some = sweep.select(np.arange(first, min(first + portion, len(sweep))))
            frames = render(scene, some.probe, some.poses, height=some.height, width=some.width, backend=backend)
            planes = tuple(frames[name].cpu() for name in ("bmode", "coverage", "transmittance"))
            distances = view_distances(views, some.poses, some.probe)
            columns = [term.flatten()[::stride] for term in variance_terms(planes, distances, bands)]
            terms.append(torch.stack(columns, dim=1).double().numpy())
            errors = torch.from_numpy(some.images).float().div_(255.0) - planes[0]
            squares.append(in_cells(errors.square()).flatten()[::stride].double().numpy())
    far_terms, far_squares = _far_away(bands)
    weight = FAR_SHARE * sum(map(len, squares)) / len(far_squares)
    variances = likeliest_variances(
        np.concatenate([*terms, far_terms]),
        np.concatenate([*squares, far_squares]),
        np.concatenate([*(np.ones(len(some)) for some in squares), np.full(len(far_squares), weight)]),
    )
    return Uncertainty(tuple(variances.tolist()), bands)


def likeliest_variances(terms: FloatArray, squares: FloatArray, weights: FloatArray) -> FloatArray:  # [M, K], [M], [M]
    """c ≥ 0 for which terms @ c fits squared errors best, their spread taken as growing with them (Poisson's deviance).

    Multiplicative updates (Richardson 1972, Lucy 1974), which keep every cₖ positive and always gain.
    """
    found = np.full(terms.shape[1], 0.05)
    sums = np.maximum(terms.T @ weights, 1e-12)
    for _ in range(ITERATIONS):
        expected = np.maximum(terms @ found, 1e-9)
        found = found * (terms.T @ (weights * squares / expected)) / sums
    return found


def _bands(images: ByteArray) -> DepthBands:  # [F, H, W]
    edges = np.linspace(0, images.shape[1], DEPTHS + 1).round().astype(int)
    bands = [images[:, low:high] / np.float32(255.0) for low, high in pairwise(edges)]
    return DepthBands(tuple(float(band.mean()) for band in bands), tuple(float(band.var()) for band in bands))


def _far_away(bands: DepthBands) -> tuple[FloatArray, FloatArray]:  # [DEPTHS, TERMS], [DEPTHS]
    """The terms of a black frame far from every view, and its expected squared error, in the middle of each band."""
    dark, lit = torch.zeros(1, DEPTHS, 1), torch.ones(1, DEPTHS, 1)
    far = np.full((1, DEVIATION_POINTS, DEVIATION_POINTS), FAR_MM)
    columns = [term.flatten() for term in variance_terms((dark, dark, lit), (far, far), bands)]
    squares = np.array(bands.spread) + np.square(bands.level)
    return torch.stack(columns, dim=1).double().numpy(), squares
