"""Modes of motion: how the tissue of a scene moves, each mode a field of displacements times a number that changes.

The displacement of tissue at x is u(x) = Σ (aₖ − rₖ)·uₖ(x), with aₖ the number of mode k (a belt's reading, a phase of
the heartbeat), rₖ its value at rest, and uₖ cubic B-splines on one coarse grid (`ultragray.scene.deformation`). Frames
were seen with numbers between `low` and `high`; what lies beyond is extrapolated, and the confidence of frames falls.

Modes are an entry of the scene file's metadata of their own: a reader that knows nothing of motion reads a still scene.
Free of torch.
"""

from __future__ import annotations

import base64
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.contract import Contract, described, from_dict, to_dict
from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import MAX_POSITION_MM

MOTION_KEY = "ultragray.motion"  # in the metadata of a scene file
MAX_MODES, MAX_SIDE = 8, 64
MAX_COEFFICIENT_BYTES = 2**21  # of a header of 4 MiB, where they take a third more
BEYOND = 1.0  # spans outside what was seen to which numbers may go
DOUBT = 2.0  # by how much, at one span outside, the logarithm of the confidence has fallen

Vector: TypeAlias = tuple[float, float, float]
Coefficients: TypeAlias = npt.NDArray[np.float32]  # [M, X, Y, Z, 3] mm for one unit of the number


@dataclass(frozen=True)
class Mode(Contract):
    """One mode of motion, and the surrogate that tells its number."""

    name: str = described("Such as breathing.")
    low: float = described("Least number that a frame was seen with.")
    high: float = described("Greatest number that a frame was seen with.")
    rest: float = described("Number at which the tissue is where the scene has it.", 0.0)
    unit: str = described("Of the number; empty: it has none.", "")
    surrogate: str = described("What told the number: a belt, a column of a file.", "")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise InvalidArgument(f"a mode needs low < high, got {self.low} and {self.high}", field="low")

    @property
    def span(self) -> float:
        return self.high - self.low

    def outside(self, number: float) -> float:
        """How many spans a number lies outside of what was seen."""
        return max(self.low - number, number - self.high, 0.0) / self.span


@dataclass(frozen=True)
class Motion(Contract):
    """The modes of a scene, and the grid that their fields have in common, along the axes of the scene."""

    modes: tuple[Mode, ...] = described("At least one.", most=MAX_MODES)
    origin_mm: Vector = described("The first spline.", low=-MAX_POSITION_MM, high=MAX_POSITION_MM)
    spacing_mm: Vector = described("Between splines.", above=0.0, high=MAX_POSITION_MM)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.modes:
            raise InvalidArgument("motion needs at least one mode", field="modes")

    @property
    def rest(self) -> tuple[float, ...]:
        return tuple(mode.rest for mode in self.modes)

    def checked(self, phase: Sequence[float]) -> tuple[float, ...]:
        """The numbers. Raises InvalidArgument where they are not one a mode, or too far from what was seen."""
        if len(phase) != len(self.modes):
            names = ", ".join(mode.name for mode in self.modes)
            raise InvalidArgument(
                f"phase must have one number for each mode ({names}), got {len(phase)}", field="phase"
            )
        for mode, number in zip(self.modes, phase, strict=True):
            if not mode.outside(number) <= BEYOND:
                raise InvalidArgument(
                    f"phase: {mode.name} must be within {mode.low - BEYOND * mode.span:g} and "
                    f"{mode.high + BEYOND * mode.span:g} (frames were seen between {mode.low:g} and {mode.high:g}), "
                    f"got {number:g}",
                    field="phase",
                )
        return tuple(float(number) for number in phase)

    def trust(self, phase: Sequence[float]) -> float:
        """By which the confidence of a frame is multiplied: 1 where such numbers were seen, less outside."""
        outside = (mode.outside(number) for mode, number in zip(self.modes, phase, strict=True))
        return math.exp(-DOUBT * math.hypot(*outside))


@dataclass(frozen=True)
class Breathing(Contract):
    """Regular breathing by the service's clock: the number of the first mode goes from end to end and back."""

    period_s: float = described("Of one breath.", 4.0, low=0.2, high=60.0)
    depth: float = described("Share of the range that was seen, from its low end.", 1.0, low=0.0, high=1.0 + BEYOND)

    def phase(self, motion: Motion, at_s: float | None = None) -> tuple[float, ...]:
        """The numbers at a time (none: now), other modes at rest."""
        turn = 2.0 * math.pi * ((time.time() if at_s is None else at_s) / self.period_s % 1.0)
        first = motion.modes[0]
        return first.low + first.span * self.depth * 0.5 * (1.0 - math.cos(turn)), *motion.rest[1:]


@dataclass(frozen=True, eq=False)
class Moving:
    """Motion with the coefficients of its fields. Raises InvalidArgument where they do not fit."""

    motion: Motion
    coefficients: Coefficients = field(repr=False)

    def __post_init__(self) -> None:
        shape = self.coefficients.shape
        fits = len(shape) == 5 and shape[0] == len(self.motion.modes) and shape[4] == 3
        if not fits or not all(4 <= side <= MAX_SIDE for side in shape[1:4]) or self.coefficients.dtype != np.float32:
            raise InvalidArgument(
                f"coefficients of motion must be float32 [{len(self.motion.modes)}, X, Y, Z, 3], each side from 4 to "
                f"{MAX_SIDE}, got {self.coefficients.dtype} {list(shape)}",
                field="motion",
            )
        if self.coefficients.nbytes > MAX_COEFFICIENT_BYTES or not np.isfinite(self.coefficients).all():
            raise InvalidArgument(
                f"coefficients of motion must be finite, and at most {MAX_COEFFICIENT_BYTES} bytes, got "
                f"{self.coefficients.nbytes}",
                field="motion",
            )

    def is_same(self, other: Moving) -> bool:
        return self.motion == other.motion and np.array_equal(self.coefficients, other.coefficients)

    def to_json(self) -> str:
        document = {
            **to_dict(self.motion),
            "shape": self.coefficients.shape,
            "coefficients": base64.b64encode(self.coefficients.astype("<f4").tobytes()).decode(),
        }
        return json.dumps(document, allow_nan=False, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Moving:
        """Inverse of `to_json`. Raises ValueError (InvalidArgument among them), saying what is wrong."""
        document: dict[str, Any] = json.loads(text)
        if not isinstance(document, dict) or not {"shape", "coefficients"} <= document.keys():
            raise ValueError("its motion is no JSON object with a shape and coefficients")
        shape, data = document.pop("shape"), base64.b64decode(document.pop("coefficients"), validate=True)
        return cls(from_dict(Motion, document), np.frombuffer(data, "<f4").astype(np.float32).reshape(shape))
