"""The extrapolation of a frame from what its scene was trained on, and the confidence in it."""

from .assess import SUPPORT_COVERAGE, Assessor, Extrapolation, supported
from .figures import FIGURES, figure_arrays
from .limit import is_confident, low_confidence, require_confidence
from .model import ConfidenceModel

__all__ = [
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
