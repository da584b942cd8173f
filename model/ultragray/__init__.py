"""UltraG-Ray scenes: 3D Gaussians with a physics-based ray model, rendered as ultrasound.

    from ultragray import GaussianScene, LinearProbe, render

The names that need torch are imported on first use, so that a process which only checks poses stays light.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from .errors import UltragrayError
from .installation import __version__ as __version__
from .pose import check_poses, pose_from_position_quaternion, quaternion_from_pose
from .probe import ConvexProbe, ElevationBeam, LinearProbe, PhasedProbe, Probe, RadialProbe, SteeredProbe
from .scene_info import SceneHeader, SceneInfo, read_header

if TYPE_CHECKING:
    from .rendering import Frames, render
    from .scene import GaussianScene

__all__ = [
    "ConvexProbe",
    "ElevationBeam",
    "Frames",
    "GaussianScene",
    "LinearProbe",
    "PhasedProbe",
    "Probe",
    "RadialProbe",
    "SceneHeader",
    "SceneInfo",
    "SteeredProbe",
    "UltragrayError",
    "check_poses",
    "pose_from_position_quaternion",
    "quaternion_from_pose",
    "read_header",
    "render",
]

_NEEDS_TORCH = {"Frames": "rendering", "GaussianScene": "scene", "render": "rendering"}


def __getattr__(name: str) -> Any:
    if name in _NEEDS_TORCH:
        value = getattr(importlib.import_module(f".{_NEEDS_TORCH[name]}", __name__), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
