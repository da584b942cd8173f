"""A least confidence that frames must have. Needs no torch."""

from __future__ import annotations

from collections.abc import Sequence

from ultragray.confidence.assess import Extrapolation
from ultragray.errors import LowConfidence


def is_confident(extrapolation: Extrapolation, min_confidence: float) -> bool:
    """Whether a frame has the least confidence; one whose confidence is not known has none."""
    return (extrapolation.confidence or 0.0) >= min_confidence


def low_confidence(extrapolation: Extrapolation, min_confidence: float, field: str) -> LowConfidence:
    """The error of a pose, named by its field, that does not have the least confidence."""
    detail = f"{field} has a confidence of {extrapolation.confidence or 0.0:.2f}, {min_confidence:g} is asked for"
    if extrapolation.distance_mm is not None and extrapolation.angle_deg is not None:
        away = f"{extrapolation.distance_mm:.1f} mm and {extrapolation.angle_deg:.1f} degrees away"
        detail = f"{detail}: the nearest training views are {away}"
    return LowConfidence(detail, field=field)


def require_confidence(
    extrapolations: Sequence[Extrapolation], min_confidence: float | None, *, first: int = 0
) -> None:
    """Raises LowConfidence for the first of many poses that does not have the least confidence (None: any will do).

    `first`: the number that they begin with.
    """
    if min_confidence is None:
        return
    for number, extrapolation in enumerate(extrapolations, first):
        if not is_confident(extrapolation, min_confidence):
            raise low_confidence(extrapolation, min_confidence, f"poses[{number}]")
