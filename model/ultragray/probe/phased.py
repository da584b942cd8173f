"""The phased array."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ultragray.contract import kind_field
from ultragray.probe.fan import Fan, opening_field
from ultragray.probe.probe import length_field


@dataclass(frozen=True)
class PhasedProbe(Fan):
    """A phased array: scan lines fan out from the centre of the face; `near_mm` is 0."""

    opening_angle_deg: float = opening_field()
    far_mm: float = length_field("Depth at which the image ends.", above=0.0, example=50.0)
    kind: Literal["phased"] = kind_field("phased")

    near_mm = 0.0
