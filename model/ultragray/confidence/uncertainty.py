"""The model behind the output `uncertainty`: the variances that add up to that of a pixel's error. Needs no torch.

    σ² = Σ cₖ·vₖ,  cₖ ≥ 0

The terms vₖ are those of `ultragray.confidence.deviation`. Those that grow with the distance to
the training views are shares of V = spread + (level − B̄)²: the mean squared error of a pixel that shows B̄ where the
true grey value may be any of those that the training images have at that depth.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ultragray.errors import InvalidArgument

TERMS = ("floor", "level", "level²", "texture", "gap 0.3 mm", "gap 1 mm", "gap 3 mm", "beyond", "thin", "shadow")
DEPTHS = 8  # bands of depth of the training images, each with its level and spread
DIGITS = 6  # in a scene's metadata


@dataclass(frozen=True)
class DepthBands:
    """Mean and variance of the training images' grey values, in [0, 1], in bands of depth.

    Raises InvalidArgument for numbers that cannot be.
    """

    level: tuple[float, ...]  # [DEPTHS]
    spread: tuple[float, ...]  # [DEPTHS]

    def __post_init__(self) -> None:
        for name in ("level", "spread"):
            object.__setattr__(self, name, _amounts(name, getattr(self, name), DEPTHS))


@dataclass(frozen=True)
class Uncertainty:
    """Fitted cₖ, and the depth bands of the training images.

    Raises InvalidArgument for numbers that cannot be.
    """

    variances: tuple[float, ...]  # [TERMS]
    bands: DepthBands

    def __post_init__(self) -> None:
        object.__setattr__(self, "variances", _amounts("variances", self.variances, len(TERMS)))

    def to_dict(self) -> dict[str, Any]:
        """A JSON object, as a scene's metadata holds it."""
        numbers = {"variances": self.variances, "level": self.bands.level, "spread": self.bands.spread}
        return {name: [round(value, DIGITS) for value in values] for name, values in numbers.items()}

    @classmethod
    def from_dict(cls, document: Any) -> Uncertainty:
        """Inverse of `to_dict`, but for the digits. Raises InvalidArgument for keys or values that cannot be."""
        expected = {"variances", "level", "spread"}
        if not isinstance(document, Mapping) or set(document) != expected:
            found = sorted(document) if isinstance(document, Mapping) else document
            raise InvalidArgument(
                f"uncertainty must be an object with the keys {sorted(expected)}, got {found!r}", field="uncertainty"
            )
        return cls(document["variances"], DepthBands(document["level"], document["spread"]))


def _amounts(name: str, values: Any, count: int) -> tuple[float, ...]:
    field = f"uncertainty.{name}"
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        raise InvalidArgument(f"{field} must be numbers, got {values!r}", field=field) from None
    if len(numbers) != count or not all(math.isfinite(value) and value >= 0.0 for value in numbers):
        raise InvalidArgument(f"{field} must be {count} numbers, at least 0, got {values!r}", field=field)
    return numbers
