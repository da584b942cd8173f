"""ElevationBeam: how thick a slice of tissue an image shows, by depth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument
from ultragray.probe.probe import MAX_LENGTH_MM, length_field

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
MAX_THICKNESS_MM = 100.0
MIN_DEPTH_OF_FIELD_MM = 0.1


@dataclass(frozen=True)
class ElevationBeam(Contract):
    """A Gaussian beam across the image plane, with a focus (docs/physics.md §3).

    Its thickness at a depth s is thickness_mm·√(1 + ((s − focus_mm)/z_R)²), its Rayleigh range z_R half the depth of
    field. With neither focus nor depth of field it is as thick at every depth.
    Raises InvalidArgument for one of the two without the other.
    """

    thickness_mm: float = described(
        "Thickness at the focus: full width at half maximum along elevation.", low=0.0, high=MAX_THICKNESS_MM
    )
    focus_mm: float | None = length_field(
        "Depth of the focus below the probe's face; none: the same thickness at every depth.", default=None
    )
    depth_of_field_mm: float | None = described(
        "Depth over which it is at most √2 times as thick as at the focus: twice the Rayleigh range.",
        None,
        low=MIN_DEPTH_OF_FIELD_MM,
        high=MAX_LENGTH_MM,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.focus_mm is None) != (self.depth_of_field_mm is None):
            missing = "focus_mm" if self.focus_mm is None else "depth_of_field_mm"
            raise InvalidArgument(
                f"{missing} must be given: a beam has a focus and a depth of field, or neither", field=missing
            )

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Thickness, focus and depth of field in mm; focus 0 and an infinite depth of field where it has none."""
        if self.focus_mm is None or self.depth_of_field_mm is None:
            return self.thickness_mm, 0.0, math.inf
        return self.thickness_mm, self.focus_mm, self.depth_of_field_mm

    def thickness_at_mm(self, depth_mm: float) -> float:
        """Full width at half maximum at a depth below the face."""
        thickness, focus, depth_of_field = self.numbers
        return thickness * math.hypot(1.0, 2.0 * (depth_mm - focus) / depth_of_field)

    @property
    def is_thin(self) -> bool:
        """Whether it is a plane."""
        return self.thickness_mm == 0.0

    def as_thick_as(self, thickness_mm: float) -> ElevationBeam:
        """A beam of the same shape with another thickness."""
        return replace(self, thickness_mm=thickness_mm)


PLANE = ElevationBeam(thickness_mm=0.0)
"""No beam: an infinitely thin slice."""
