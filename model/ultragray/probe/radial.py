"""The radial probe: intravascular and endobronchial catheters, rotating endoscopes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ultragray.contract import kind_field
from ultragray.probe.probe import Probe, length_field
from ultragray.probe.scan_lines import RadialLines


@dataclass(frozen=True)
class RadialProbe(Probe):
    """Scan lines all the way round in the image plane, outwards from a ring about the origin.

    Line j of W runs at the angle 360°·(j+½)/W from z towards +x; the last is followed by the first.
    """

    near_mm: float = length_field(
        "Radius of the ring: distance from the centre at which the image begins.", example=1.0
    )
    far_mm: float = length_field(
        "Distance from the centre at which the image ends, beyond `near_mm`.", above=0.0, example=20.0
    )
    kind: Literal["radial"] = kind_field("radial")

    usual_scan_lines_mm = (1.0, 150.0)

    @property
    def lines(self) -> RadialLines:
        return RadialLines()

    @property
    def face_depth_mm(self) -> float:
        return self.near_mm

    @property
    def pivot_depth_mm(self) -> float:
        return 0.0
