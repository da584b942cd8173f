"""A box: a plate, a block, a guide."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal

import numpy as np
from typing_extensions import Self

from ultragray.contract import described, kind_field
from ultragray.errors import InvalidArgument
from ultragray.pose import ROTATION_TOLERANCE, pose_from_position_quaternion, quaternion_from_pose
from ultragray.probe import FloatArray
from ultragray.probe.probe import MAX_LENGTH_MM
from ultragray.tools.crossing import Crossing, ScanView
from ultragray.tools.solid import Span, between_planes, crossing_of_solid, overlap
from ultragray.tools.tool import LEAST_THICKNESS_MM, Tool, ToolFrame, moved_point, point_field


@dataclass(frozen=True, kw_only=True)
class Box(Tool):
    """A solid box about a point, turned about it.

    Raises InvalidArgument for a quaternion whose norm is not 1 within 1e-3.
    """

    kind: Literal["box"] = kind_field("box")
    centre_mm: tuple[float, float, float] = point_field("x, y and z of its middle.", example=(0.0, 0.0, 30.0))
    quaternion: tuple[float, float, float, float] = described(
        "w, x, y and z of the rotation from the box to its frame.", (1.0, 0.0, 0.0, 0.0), low=-1.001, high=1.001, most=4
    )
    size_mm: tuple[float, float, float] = described(
        "Lengths along its own x, y and z.",
        low=LEAST_THICKNESS_MM,
        high=MAX_LENGTH_MM,
        most=3,
        example=(20.0, 10.0, 4.0),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        norm = math.hypot(*self.quaternion)
        if abs(norm - 1.0) > ROTATION_TOLERANCE:
            raise InvalidArgument(
                f"quaternion must have norm 1 within {ROTATION_TOLERANCE:g}, got norm {norm:.6g}", field="quaternion"
            )

    @property
    def thickness_mm(self) -> float:
        return min(self.size_mm)

    def moved(self, pose: FloatArray) -> Self:
        box = pose_from_position_quaternion(self.centre_mm, self.quaternion)  # box→frame
        centre_mm, quaternion = moved_point(pose, self.centre_mm), quaternion_from_pose(pose @ box)
        return replace(self, frame=ToolFrame.SCENE, centre_mm=centre_mm, quaternion=quaternion)

    def crossing(self, view: ScanView) -> Crossing:
        pose = pose_from_position_quaternion(self.centre_mm, self.quaternion)  # box→frame
        half = 0.5 * np.array(self.size_mm)

        def span(places: FloatArray, steps: FloatArray) -> Span:
            return reduce(overlap, (between_planes(places[..., i], steps[..., i], half[i]) for i in range(3)))

        return crossing_of_solid(self, view, np.vstack([pose[:3, 3], pose[:3, 3] + pose[:3, :3].T]), span)
