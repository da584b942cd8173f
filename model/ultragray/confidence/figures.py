"""The figures of many frames as arrays. Needs no torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import numpy.typing as npt

from .assess import Extrapolation

FIGURES = tuple(figure.name for figure in fields(Extrapolation))


def figure_arrays(extrapolations: Sequence[Extrapolation]) -> dict[str, npt.NDArray[np.float32]]:
    """Each of FIGURES as [C], NaN where it is not known."""
    return {name: np.array([getattr(told, name) for told in extrapolations], dtype=np.float32) for name in FIGURES}
