"""The fit of the model of `confidence` to frames whose scores are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ultragray.confidence.model import TERMS, Support, logistic, predicted, within
from ultragray.confidence.views import ViewMeasures
from ultragray.probe import FloatArray

PRIOR_WEIGHTS = (3.6, 1.1, 1.5, 0.3, 0.6)  # about those of ten scenes; one that no view determines stays near its own
PRIOR_STRENGTH = 0.1  # squared error that is added for a weight that is 1 away from its prior
SHIFT_STRENGTH = 0.02  # the same of the shift between a scene's frames and interpolated ones, whose prior is 0
GAIN_QUANTILE = 0.85  # share of the frames, of those that the gain is fitted on, that stay below the limit
LEAST_SHARE = 0.02  # of supported pixels: fewer are taken as this many
REACHES_MM = np.geomspace(0.2, 30.0, 60)  # values of r that are tried
FIT_STEPS = 100


@dataclass(frozen=True, eq=False)
class Examples:
    """Frames with the terms of their poses and the MS-SSIM that they reached."""

    terms: FloatArray  # [C, K, 1 + TERMS]
    ms_ssim: FloatArray  # [C]


def fit_support(
    measures: ViewMeasures,
    shares: FloatArray,  # [C] of supported pixels
    ms_ssim: FloatArray,  # [C]
    black_ms_ssim: float,
) -> Support:
    """The gain, at least 1, that holds for GAIN_QUANTILE of the frames; share and reach of the least squared error."""
    reached = (ms_ssim - black_ms_ssim) / ((1.0 - black_ms_ssim) * np.maximum(shares, LEAST_SHARE))
    found = []
    for reach_mm in REACHES_MM:
        near = within(measures.distance_mm, reach_mm)
        share = min(1.0, max(LEAST_SHARE, float(near @ shares) / max(float(near @ near), 1e-9)))
        found.append((float(np.square(share * near - shares).sum()), share, float(reach_mm)))
    _, share, reach_mm = min(found)
    return Support(max(1.0, float(np.quantile(reached, GAIN_QUANTILE))), share, reach_mm)


def fit_weights(
    rendered: Examples,
    black_ms_ssim: float,
    interpolated: Examples | None = None,
) -> FloatArray:  # [1 + TERMS]
    """The weights with the least squared error of the figure, and little away from PRIOR_WEIGHTS; only w₀ may be < 0.

    Interpolated frames, as many as they may be, count as much as the rendered ones. They reach other scores at the
    same place: a shift of w₀, fitted too, is theirs alone, so that they tell how scores fall and not how high they are.
    Levenberg-Marquardt steps; a weight that would turn negative is held at 0.
    """
    parts = [rendered] if interpolated is None or not len(interpolated.ms_ssim) else [rendered, interpolated]
    counts = [len(part.ms_ssim) for part in parts]
    shifted = np.repeat([0.0, 1.0][: len(parts)], counts)  # [C]
    shares = np.repeat([counts[0] / count for count in counts], counts)  # [C] of each squared error
    terms = np.concatenate([part.terms for part in parts])
    terms = np.concatenate([terms, np.broadcast_to(shifted[:, None, None], (*terms.shape[:2], 1))], axis=2)
    ms_ssim = np.concatenate([part.ms_ssim for part in parts])
    prior = np.array([*PRIOR_WEIGHTS, 0.0])
    strength = np.array([PRIOR_STRENGTH] * len(PRIOR_WEIGHTS) + [SHIFT_STRENGTH])
    bounded = slice(1, 1 + TERMS)
    weights, damping = prior.copy(), 1.0

    def cost(candidate: FloatArray) -> float:
        misses = predicted(candidate, terms, black_ms_ssim) - ms_ssim
        return float(shares @ np.square(misses) + strength @ np.square(candidate - prior))

    for _ in range(FIT_STEPS):
        curve = logistic(terms @ weights)
        slope = (1.0 - black_ms_ssim) * ((curve * (1.0 - curve))[..., None] * terms).mean(axis=1)
        misses = predicted(weights, terms, black_ms_ssim) - ms_ssim
        gradient = slope.T @ (shares * misses) + strength * (weights - prior)
        free = np.ones(len(weights), bool)
        free[bounded] = (weights[bounded] > 0.0) | (gradient[bounded] < 0.0)
        curvature = (slope.T * shares) @ slope + np.diag(strength + damping)
        step = np.zeros_like(weights)
        step[free] = np.linalg.solve(curvature[np.ix_(free, free)], -gradient[free])
        candidate = weights + step
        candidate[bounded] = np.maximum(candidate[bounded], 0.0)
        if cost(candidate) < cost(weights):
            weights, damping = candidate, max(0.3 * damping, 1e-6)
        else:
            damping = min(4.0 * damping, 1e6)
    return weights[:-1]
