"""The model behind the figure `confidence`: logistic curves over how points of a frame lie to the training views.

    c = b + (1 − b)·mean over points of σ(w₀ − w₁·log(1 + i/0.3 mm) − w₂·d/5 mm − w₃·φ/10° − w₄·h)

d, i and φ are the distance, the interpolation distance and the angle of `ViewMeasures`; h is how hard the place is: the
`hardness` of the training views around the pose, by their weights. b is what a black frame reaches. w₁ … w₄ are not
negative, so that c never rises with d, i, φ or h. Beyond the farthest point that the weights were fitted on, where no
frame confirms the curve, the excess of d counts twice.

Where Gaussians support only the share s of a frame's pixels, c ≤ b + (1 − b)·g·s; the gain g is fitted to frames with
little support. For a pose alone s is estimated as s₀·mean over points of exp(−d²/r²); of a rendered frame it is known.

Version 1, of older scenes, takes the curve of the means over the points, and has neither limit. Needs no torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ultragray.confidence.uncertainty import Uncertainty
from ultragray.confidence.views import ViewMeasures
from ultragray.errors import InvalidArgument
from ultragray.probe import FloatArray

VERSION = 2
NEAR_MM, DISTANCE_MM, ANGLE_DEG = 0.3, 5.0, 10.0  # units of the terms
TERMS = 4  # beside the constant
HARDNESS_DIGITS = 3


@dataclass(frozen=True)
class Support:
    """The limit that the share of supported pixels sets, and what that share is expected to be at a pose.

    Raises InvalidArgument for numbers that are not finite or not positive.
    """

    gain: float  # g
    share: float  # s₀, at the views
    reach_mm: float  # r

    def __post_init__(self) -> None:
        numbers = _numbers("support", (self.gain, self.share, self.reach_mm))
        if min(numbers) <= 0.0:
            raise InvalidArgument(f"support must be positive numbers, got {list(numbers)}", field="support")

    def expected_shares(self, measures: ViewMeasures) -> FloatArray:  # [C]
        """The share of supported pixels that frames at these poses are taken to have."""
        return self.share * within(measures.distance_mm, self.reach_mm)


@dataclass(frozen=True)
class ConfidenceModel:
    """Fitted weights w₀ … w₄, b, and the hardness of each training view; `fitted_on` and `error` describe the fit.

    Raises InvalidArgument for numbers that are not finite or out of range.
    """

    weights: tuple[float, ...]  # w₀ … w₄
    black_ms_ssim: float  # b
    hardness: tuple[float, ...]  # [P]
    fitted_on: int  # held-out views
    error: float  # mean absolute error on those views
    support: Support | None = None  # None: it sets no limit
    fitted_to_mm: float | None = None  # the farthest point of those views; None: any
    uncertainty: Uncertainty | None = None  # of pixels; None: not known
    version: int = VERSION

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
        if self.fitted_to_mm is not None and _numbers("fitted_to_mm", [self.fitted_to_mm])[0] < 0.0:
            raise InvalidArgument(f"fitted_to_mm must be at least 0, got {self.fitted_to_mm:g}", field="fitted_to_mm")
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "hardness", _numbers("hardness", self.hardness))

    def predict(self, measures: ViewMeasures) -> FloatArray:  # [C]
        """The MS-SSIM expected at each pose, in [0, 1]."""
        if self.version == 1:
            measures = measures.averaged()
        terms = terms_of(measures, np.array(self.hardness), self.fitted_to_mm)
        expected = predicted(np.array(self.weights), terms, self.black_ms_ssim)
        return expected if self.support is None else self.limited(expected, self.support.expected_shares(measures))

    def limited(self, confidences: FloatArray, supported_shares: FloatArray) -> FloatArray:  # [C] both
        """The confidences of poses, limited by the share of their pixels that has support."""
        if self.support is None:
            return confidences
        shares = np.minimum(1.0, self.support.gain * supported_shares)
        most: FloatArray = self.black_ms_ssim + (1.0 - self.black_ms_ssim) * shares
        return np.minimum(confidences, most)

    def to_dict(self) -> dict[str, Any]:
        """A JSON object, as a scene's metadata holds it."""
        document = {
            **asdict(self),
            "weights": list(self.weights),
            "hardness": [round(value, HARDNESS_DIGITS) for value in self.hardness],
            "uncertainty": None if self.uncertainty is None else self.uncertainty.to_dict(),
        }
        return {key: document[key] for key in _KEYS[self.version]}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> ConfidenceModel:
        """Inverse of `to_dict`, but for the digits of `hardness`.

        Raises InvalidArgument for another version, a missing or a surplus key, and values that cannot be.
        """
        version = document.get("version") if isinstance(document, Mapping) else None
        if type(version) is not int or version not in _KEYS:
            known = " or ".join(map(str, _KEYS))
            raise InvalidArgument(
                f"confidence must be an object of version {known}, got {version!r}", field="confidence"
            )
        if set(document) != set(_KEYS[version]):
            raise InvalidArgument(
                f"confidence of version {version} must have the keys {sorted(_KEYS[version])}, got {sorted(document)}",
                field="confidence",
            )
        support, uncertainty = document.get("support"), document.get("uncertainty")
        parts = {
            "support": None if support is None else _support_of(support),
            "uncertainty": None if uncertainty is None else Uncertainty.from_dict(uncertainty),
        }
        return cls(**{**document, **parts})


_KEYS_1 = ("version", "weights", "black_ms_ssim", "hardness", "fitted_on", "error")
_KEYS = {1: _KEYS_1, 2: (*_KEYS_1, "support", "fitted_to_mm", "uncertainty")}


def terms_of(
    measures: ViewMeasures,
    hardness: FloatArray,  # [P]
    fitted_to_mm: float | None = None,
) -> FloatArray:  # [C, K, 1 + TERMS]
    """The factors of the weights at each point: 1 and the negative terms of the formula."""
    distance_mm = measures.distance_mm
    if fitted_to_mm is not None:
        distance_mm = distance_mm + np.maximum(distance_mm - fitted_to_mm, 0.0)
    columns = (
        np.full_like(distance_mm, -1.0),
        np.log1p(measures.interpolation_mm / NEAR_MM),
        distance_mm / DISTANCE_MM,
        measures.angle_deg / ANGLE_DEG,
        np.broadcast_to((measures.weights @ hardness)[:, None], distance_mm.shape),
    )
    return -np.stack(columns, axis=-1)


def predicted(weights: FloatArray, terms: FloatArray, black_ms_ssim: float) -> FloatArray:  # [C]
    """c of each pose, by the formula."""
    shares: FloatArray = logistic(terms @ weights).mean(axis=1)
    return black_ms_ssim + (1.0 - black_ms_ssim) * shares


def within(distance_mm: FloatArray, reach_mm: float) -> FloatArray:  # [C, K] -> [C]
    """The mean over the points of exp(−d²/r²)."""
    shares: FloatArray = np.exp(-np.square(distance_mm / reach_mm)).mean(axis=1)
    return shares


def logistic(values: FloatArray) -> FloatArray:
    """σ of the formula."""
    return 1.0 / (1.0 + np.exp(-np.clip(values, -500.0, 500.0)))


def _support_of(document: Any) -> Support:
    expected = set(Support.__dataclass_fields__)
    if not isinstance(document, Mapping) or set(document) != expected:
        found = sorted(document) if isinstance(document, Mapping) else document
        raise InvalidArgument(
            f"support must be an object with the keys {sorted(expected)}, got {found!r}", field="support"
        )
    return Support(**document)


def _numbers(name: str, values: Any) -> tuple[float, ...]:
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        raise InvalidArgument(f"{name} must be numbers, got {values!r}", field=name) from None
    if not all(map(math.isfinite, numbers)):
        raise InvalidArgument(f"{name} must be finite, got {values!r}", field=name)
    return numbers
