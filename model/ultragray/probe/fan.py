"""The base of convex and phased arrays."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ultragray.contract import described
from ultragray.probe.probe import Probe
from ultragray.probe.scan_lines import FannedLines

LARGEST_OPENING_DEG = 175.0
SMALLEST_USUAL_OPENING_DEG = 5.0


def opening_field() -> Any:
    """The field for the angle of a fan."""
    return described("Full angle of the fan.", above=0.0, high=LARGEST_OPENING_DEG, example=60.0)


class Fan(Probe):
    """A probe whose scan lines fan out from an apex at the origin, at even angles."""

    opening_angle_deg: float

    @property
    def lines(self) -> FannedLines:
        return FannedLines(self.opening_angle_deg)

    @property
    def face_depth_mm(self) -> float:
        return self.near_mm

    def oddities(self) -> Iterator[str]:
        yield from super().oddities()
        if self.opening_angle_deg < SMALLEST_USUAL_OPENING_DEG:
            yield (
                f"the fan opens by {self.opening_angle_deg:.3g}°, where {SMALLEST_USUAL_OPENING_DEG:g}° and more are "
                "usual: an angle in radians? (conf.json is in degrees)"
            )
