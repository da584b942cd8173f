"""The model behind the figure `confidence`: a logistic curve over how a pose lies to the training views.

    c = b + (1 − b)·σ(w₀ − w₁·log(1 + i/0.3 mm) − w₂·d/5 mm − w₃·φ/10° − w₄·h)

d, i and φ are the distance, the interpolation distance and the angle of `ViewMeasures`; h is how hard the place is: the
`hardness` of the training views around the pose, by their weights. b is what a black frame reaches. w₁ … w₄ are not
negative: a pose farther away never earns more confidence. Needs no torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..errors import InvalidArgument
from ..probe import FloatArray
from .views import ViewMeasures

VERSION = 1
NEAR_MM, DISTANCE_MM, ANGLE_DEG = 0.3, 5.0, 10.0  # units of the terms
TERMS = 4  # beside the constant
PRIOR_WEIGHTS = (3.4, 1.1, 1.4, 0.05, 0.6)  # of fourteen in-silico scenes; what the views cannot tell stays near it
PRIOR_STRENGTH = 1.0  # squared error that a weight costs which is 1 away from its prior
FIT_STEPS = 100
HARDNESS_DIGITS = 3


@dataclass(frozen=True)
class ConfidenceModel:
    """Fitted weights w₀ … w₄, b, and the hardness of each training view; `fitted_on` and `error` say from what.

    Raises InvalidArgument for numbers that are not finite or out of range.
    """

    weights: tuple[float, ...]  # w₀ … w₄
    black_ms_ssim: float  # b
    hardness: tuple[float, ...]  # [P]
    fitted_on: int  # held-out views
    error: float  # mean absolute error on those views

    def __post_init__(self) -> None:
        weights = _numbers("weights", self.weights)
        if len(weights) != 1 + TERMS or min(weights[1:]) < 0.0:
            raise InvalidArgument(
                f"weights must be {1 + TERMS} numbers, from the second on at least 0, got {list(weights)}",
                field="weights",
            )
        black, error = _numbers("black_ms_ssim and error", (self.black_ms_ssim, self.error))
        if not (0.0 <= black < 1.0 and 0.0 <= error <= 1.0):
            raise InvalidArgument(
                f"black_ms_ssim and error must be in [0, 1], got {black:g} and {error:g}", field="black_ms_ssim"
            )
        if type(self.fitted_on) is not int or self.fitted_on < 1:
            raise InvalidArgument(f"fitted_on must be a positive integer, got {self.fitted_on!r}", field="fitted_on")
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "hardness", _numbers("hardness", self.hardness))

    def predict(self, measures: ViewMeasures) -> FloatArray:  # [C]
        """The MS-SSIM expected at each pose, in [0, 1]."""
        terms = terms_of(measures, np.array(self.hardness))
        return predicted(np.array(self.weights), terms, self.black_ms_ssim)

    def to_dict(self) -> dict[str, Any]:
        """A JSON object, as a scene's metadata holds it."""
        return {
            "version": VERSION,
            **asdict(self),
            "weights": list(self.weights),
            "hardness": [round(value, HARDNESS_DIGITS) for value in self.hardness],
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> ConfidenceModel:
        """Inverse of `to_dict`, but for the digits of `hardness`.

        Raises InvalidArgument for another version, a missing or a surplus key, and values that cannot be.
        """
        expected = {"version", *cls.__dataclass_fields__}
        if not isinstance(document, Mapping) or set(document) != expected:
            found = sorted(document) if isinstance(document, Mapping) else document
            raise InvalidArgument(
                f"confidence must be an object with the keys {sorted(expected)}, got {found!r}", field="confidence"
            )
        if document["version"] != VERSION:
            raise InvalidArgument(
                f"confidence must be of version {VERSION}, got {document['version']!r}", field="confidence"
            )
        return cls(**{key: value for key, value in document.items() if key != "version"})


def terms_of(measures: ViewMeasures, hardness: FloatArray) -> FloatArray:  # [P] -> [C, 1 + TERMS]
    """The factors of the weights: 1 and the negative terms of the formula."""
    columns = (
        np.full(len(measures.distance_mm), -1.0),
        np.log1p(measures.interpolation_mm / NEAR_MM),
        measures.distance_mm / DISTANCE_MM,
        measures.angle_deg / ANGLE_DEG,
        measures.weights @ hardness,
    )
    return -np.stack(columns, axis=1)


def predicted(weights: FloatArray, terms: FloatArray, black_ms_ssim: float) -> FloatArray:  # [C]
    """The formula."""
    return black_ms_ssim + (1.0 - black_ms_ssim) * _logistic(terms @ weights)


def fit_weights(terms: FloatArray, ms_ssim: FloatArray, black_ms_ssim: float) -> FloatArray:  # [C, 1 + TERMS], [C]
    """The weights with the least squared error of the figure, and little away from PRIOR_WEIGHTS; only w₀ may be < 0.

    Levenberg-Marquardt steps; a weight that would turn negative is held at 0.
    """
    prior = np.array(PRIOR_WEIGHTS)
    weights, damping = prior.copy(), 1.0

    def cost(candidate: FloatArray) -> float:
        misses = predicted(candidate, terms, black_ms_ssim) - ms_ssim
        return float(misses @ misses + PRIOR_STRENGTH * np.square(candidate - prior).sum())

    for _ in range(FIT_STEPS):
        share = _logistic(terms @ weights)
        slope = ((1.0 - black_ms_ssim) * share * (1.0 - share))[:, None] * terms
        misses = predicted(weights, terms, black_ms_ssim) - ms_ssim
        gradient = slope.T @ misses + PRIOR_STRENGTH * (weights - prior)
        free = (weights > 0.0) | (gradient < 0.0)
        free[0] = True
        curvature = slope.T @ slope + (PRIOR_STRENGTH + damping) * np.eye(len(prior))
        step = np.zeros_like(weights)
        step[free] = np.linalg.solve(curvature[np.ix_(free, free)], -gradient[free])
        candidate = weights + step
        candidate[1:] = np.maximum(candidate[1:], 0.0)
        if cost(candidate) < cost(weights):
            weights, damping = candidate, max(0.3 * damping, 1e-6)
        else:
            damping = min(4.0 * damping, 1e6)
    return weights


def _logistic(values: FloatArray) -> FloatArray:
    return 1.0 / (1.0 + np.exp(-np.clip(values, -500.0, 500.0)))


def _numbers(name: str, values: Any) -> tuple[float, ...]:
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        raise InvalidArgument(f"{name} must be numbers, got {values!r}", field=name) from None
    if not all(map(math.isfinite, numbers)):
        raise InvalidArgument(f"{name} must be finite, got {values!r}", field=name)
    return numbers
