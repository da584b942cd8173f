"""A cylinder: a rod, a trocar, a drill."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ultragray.contract import kind_field
from ultragray.probe import FloatArray
from ultragray.tools.crossing import Crossing, ScanView
from ultragray.tools.shaft import Shaft
from ultragray.tools.solid import Span, between_planes, crossing_of_solid, overlap, within_radius


@dataclass(frozen=True, kw_only=True)
class Cylinder(Shaft):
    """A solid cylinder with flat ends, thicker than the beam: its near side is seen. What is thinner is a needle.

    Raises InvalidArgument for a hub at the tip.
    """

    kind: Literal["cylinder"] = kind_field("cylinder")

    def crossing(self, view: ScanView) -> Crossing:
        tip, hub = np.array(self.tip_mm), np.array(self.hub_mm)
        length = float(np.linalg.norm(hub - tip))
        axis = (hub - tip) / length
        aside = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        aside /= np.linalg.norm(aside)
        middle = (tip + hub) / 2.0

        def span(places: FloatArray, steps: FloatArray) -> Span:
            wall = within_radius(places[..., :2], steps[..., :2], 0.5 * self.diameter_mm)
            return overlap(wall, between_planes(places[..., 2], steps[..., 2], 0.5 * length))

        axes = np.stack([np.cross(aside, axis), aside, axis])
        return crossing_of_solid(self, view, np.vstack([middle, middle + axes]), span)
