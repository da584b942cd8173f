"""The curved array."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ultragray.contract import kind_field
from ultragray.probe.fan import Fan, opening_field
from ultragray.probe.probe import length_field


@dataclass(frozen=True)
class ConvexProbe(Fan):
    """A curved array: scan lines fan out from the apex, which is the origin."""

    opening_angle_deg: float = opening_field()
    near_mm: float = length_field("Radius of the face: distance from the apex at which the image begins.", example=40.0)
    far_mm: float = length_field(
        "Distance from the apex at which the image ends, beyond `near_mm`.", above=0.0, example=90.0
    )
    kind: Literal["convex"] = kind_field("convex")
