"""The linear array with steered beams."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ultragray.contract import described, kind_field
from ultragray.probe.probe import Probe, length_field
from ultragray.probe.scan_lines import ParallelLines

LARGEST_STEERING_DEG = 45.0


@dataclass(frozen=True)
class SteeredProbe(Probe):
    """A linear array whose scan lines, parallel, leave the face at an angle; depths are along the lines."""

    width_mm: float = length_field("Width of the face.", above=0.0, example=40.0)
    steering_deg: float = described(
        "Angle of the scan lines from the axial axis, positive towards +x.",
        low=-LARGEST_STEERING_DEG,
        high=LARGEST_STEERING_DEG,
        example=15.0,
    )
    near_mm: float = length_field("Depth along the scan lines at which the image begins.", example=0.0)
    far_mm: float = length_field(
        "Depth along the scan lines at which the image ends, beyond `near_mm`.", above=0.0, example=50.0
    )
    kind: Literal["steered"] = kind_field("steered")

    face_depth_mm = 0.0

    @property
    def lines(self) -> ParallelLines:
        return ParallelLines(self.width_mm, self.steering_deg)
