"""The base of all tools: their material, and the frame that they lie in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from typing_extensions import Self

from ultragray.contract import Family, described
from ultragray.pose import MAX_POSITION_MM
from ultragray.probe import FloatArray
from ultragray.tools.crossing import Crossing, ScanView

MAX_TOOLS = 8  # of one frame
DEFAULT_LABEL = 255
LEAST_THICKNESS_MM = 0.05
_MOST_STOPPED = 1.0 - 1e-6


class ToolFrame(str, Enum):
    """The frame that the points of a tool are in."""

    SCENE = "scene"
    PROBE = "probe"


def point_field(meaning: str, **options: Any) -> Any:
    """A field for the x, y and z of a point, mm."""
    return described(meaning, low=-MAX_POSITION_MM, high=MAX_POSITION_MM, most=3, **options)


def moved_point(pose: FloatArray, point: Sequence[float]) -> tuple[float, float, float]:  # [4, 4] mm, [3] mm
    """A point as a pose leads it."""
    x, y, z = (pose[:3, :3] @ np.array(point, np.float64) + pose[:3, 3]).tolist()
    return x, y, z


@dataclass(frozen=True, kw_only=True)
class Tool(Family):
    """A rigid body in the image. It reflects as a mirror does, and a little to all sides, and it stops the beam.

    A kind is a class: its numbers, and where scan lines cross the body that they mean (docs/howto/tools.md).
    """

    kind: str
    frame: ToolFrame = described("Of its points; probe: it moves with the probe.", ToolFrame.SCENE)
    brightness: float = described("Echo where a scan line meets it head on.", 1.0, low=0.0, high=1.0)
    roughness: float = described("Share of the brightness that is left at any angle.", 0.25, low=0.0, high=1.0)
    reverberation: float = described(
        "Strength of the first echo of its comet tail, of which each further one has the same share; 0: no tail.",
        0.4,
        low=0.0,
        high=0.9,
    )
    opacity: float = described("Share of the beam that it stops where it is met head on.", 0.6, low=0.0, high=0.999)
    label: int = described("Of its pixels in the output labels.", DEFAULT_LABEL, low=1, high=255)

    @property
    def thickness_mm(self) -> float:
        """Its thickness head on: the distance between the echoes of its comet tail, and what `opacity` is of."""
        raise NotImplementedError

    def crossing(self, view: ScanView) -> Crossing:
        """Where the scan lines meet it."""
        raise NotImplementedError

    def moved(self, pose: FloatArray) -> Self:  # [4, 4] mm, exact
        """The tool in the scene, where its points are in a frame that the pose leads into it."""
        raise NotImplementedError

    def stopped(self, path_mm: FloatArray) -> FloatArray:  # [...] -> [...]
        """The share of the beam that a way through it stops, less than 1."""
        return np.minimum(1.0 - (1.0 - self.opacity) ** (path_mm / self.thickness_mm), _MOST_STOPPED)

    def seen_by(self, view: ScanView, points: Sequence[Sequence[float]]) -> FloatArray:  # [N, 3] -> [C, N, 3]
        """Points of the tool in the probe frame of each pose, mm."""
        array = np.array(points, np.float64)
        if self.frame is ToolFrame.SCENE:
            return view.in_probe_frame(array)
        return np.broadcast_to(array, (len(view.poses), *array.shape))
