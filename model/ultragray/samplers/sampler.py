"""What every pose sampler is, and the checks of its numbers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from ..errors import InvalidArgument
from ..pose import check_poses
from ..probe import FloatArray, Probe

MAX_POSES = 100_000
MAX_SEED = 2**63 - 1
MAX_TRANSLATION_MM, MAX_ROTATION_DEG = 1000.0, 180.0


class Sampler(ABC):
    """Makes poses from base poses: those that the caller gives, else the training poses of a scene."""

    kind: ClassVar[str]

    def poses(self, base: Any, probe: Probe) -> FloatArray:  # [P, 4, 4] -> [C, 4, 4] mm
        """The poses, exact; the same base, probe and sampler give the same.

        Raises InvalidPose, and InvalidArgument where the base has too few poses or more than 100,000 would come out.
        """
        checked = check_poses(base)
        if not len(checked):
            raise InvalidArgument(f"sampler {self.kind} needs base poses, got none", field="kind")
        return check_poses(self._made(checked, probe))

    @abstractmethod
    def _made(self, base: FloatArray, probe: Probe) -> FloatArray:  # [P, 4, 4] -> [C, 4, 4] mm
        """The poses from at least one checked base pose."""

    def _require(self, holds: bool, name: str, expected: str) -> None:
        if not holds:
            told = repr(getattr(self, name))
            told = told if len(told) <= 100 else f"{told[:100]}…"
            raise InvalidArgument(f"{name} must be {expected}, got {told}", field=name)

    def _require_count(self, name: str = "count") -> None:
        expected = f"an integer from 1 to {MAX_POSES}"
        self._require(is_integer(getattr(self, name), 1, MAX_POSES), name, expected)

    def _require_seed(self) -> None:
        seed = getattr(self, "seed", None)
        self._require(is_integer(seed, 0, MAX_SEED), "seed", f"an integer from 0 to {MAX_SEED}")

    def _require_few(self, made: float, name: str) -> None:
        if made > MAX_POSES:
            raise InvalidArgument(
                f"{name} {getattr(self, name):g} gives more than the {MAX_POSES:,} poses that can be made", field=name
            )


def is_integer(value: Any, low: int, high: int) -> bool:
    """Whether it is an integer within the limits; True and False are none."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(low <= value <= high)


def is_number(value: Any, low: float, high: float) -> bool:
    """Whether it is a number within the limits, which are finite."""
    number = isinstance(value, (int, float, np.floating, np.integer)) and not isinstance(value, bool)
    return number and bool(low <= value <= high)
