"""A least confidence that frames must have. Needs no torch."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import LowConfidence
from .assess import Extrapolation


def is_confident(told: Extrapolation, min_confidence: float) -> bool:
    """Whether a frame has the least confidence; one whose confidence is not known has none."""
    return (told.confidence or 0.0) >= min_confidence


def low_confidence(told: Extrapolation, min_confidence: float, field: str) -> LowConfidence:
    """The error of a pose, named by its field, that does not have the least confidence."""
    detail = f"{field} has a confidence of {told.confidence or 0.0:.2f}, {min_confidence:g} is asked for"
    if told.distance_mm is not None and told.angle_deg is not None:
        away = f"{told.distance_mm:.1f} mm and {told.angle_deg:.1f} degrees away"
        detail = f"{detail}: the nearest training views are {away}"
    return LowConfidence(detail, field=field)


def require_confidence(extrapolations: Sequence[Extrapolation], min_confidence: float | None) -> None:
    """Raises LowConfidence for the first of `poses` that does not have the least confidence (None: any will do)."""
    if min_confidence is None:
        return
    for number, told in enumerate(extrapolations):
        if not is_confident(told, min_confidence):
            raise low_confidence(told, min_confidence, f"poses[{number}]")
