"""The extrapolation of a frame from what its scene was trained on, and the confidence in it."""

from ultragray.confidence.assess import (
    CONTACT_SHARE,
    FIGURES,
    SUPPORT_COVERAGE,
    Assessor,
    Extrapolation,
    figure_arrays,
    supported,
)
from ultragray.confidence.limit import is_confident, low_confidence, require_confidence
from ultragray.confidence.model import ConfidenceModel

__all__ = [
    "CONTACT_SHARE",
    "FIGURES",
    "SUPPORT_COVERAGE",
    "Assessor",
    "ConfidenceModel",
    "Extrapolation",
    "figure_arrays",
    "is_confident",
    "low_confidence",
    "require_confidence",
    "supported",
]
