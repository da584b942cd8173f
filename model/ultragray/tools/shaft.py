"""What is straight and has two ends."""

from __future__ import annotations

from dataclasses import dataclass, replace

from typing_extensions import Self

from ultragray.errors import InvalidArgument
from ultragray.probe import FloatArray
from ultragray.probe.probe import length_field
from ultragray.tools.tool import LEAST_THICKNESS_MM, Tool, ToolFrame, moved_point, point_field


@dataclass(frozen=True, kw_only=True)
class Shaft(Tool):
    """A round shaft from its tip to its hub.

    Raises InvalidArgument for a hub at the tip.
    """

    tip_mm: tuple[float, float, float] = point_field("x, y and z of the tip.", example=(8.0, 0.0, 30.0))
    hub_mm: tuple[float, float, float] = point_field("x, y and z of the other end.", example=(-25.0, 0.0, 5.0))
    diameter_mm: float = length_field("Diameter; 0.7 is 22 gauge.", default=0.7, low=LEAST_THICKNESS_MM)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tip_mm == self.hub_mm:
            raise InvalidArgument("hub_mm must differ from tip_mm: they say where it points", field="hub_mm")

    @property
    def thickness_mm(self) -> float:
        return self.diameter_mm

    def moved(self, pose: FloatArray) -> Self:
        tip_mm, hub_mm = moved_point(pose, self.tip_mm), moved_point(pose, self.hub_mm)
        return replace(self, frame=ToolFrame.SCENE, tip_mm=tip_mm, hub_mm=hub_mm)
