"""UltraG-Ray scenes: 3D Gaussians with a physics-based ray model, rendered as ultrasound.

    from ultragray import GaussianScene, LinearProbe, render

Every name is imported on first use, so that a process which only checks poses needs no torch, and `ultragray --help`
no NumPy.
"""

from __future__ import annotations

import importlib
import os
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from ultragray.installation import __version__ as __version__

# torch reads it when it is imported. Its threads sleep while they wait for each other, and leave the processors to the
# kernels' own threads and to other programs. If they spin, a training step takes half as long again on two cores, and
# beside other busy programs many times as long.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

if TYPE_CHECKING:
    from ultragray.errors import UltragrayError as UltragrayError
    from ultragray.geometry.pose import check_poses as check_poses
    from ultragray.geometry.pose import pose_from_position_quaternion as pose_from_position_quaternion
    from ultragray.geometry.pose import quaternion_from_pose as quaternion_from_pose
    from ultragray.geometry.probe import ConvexProbe as ConvexProbe
    from ultragray.geometry.probe import ElevationBeam as ElevationBeam
    from ultragray.geometry.probe import LinearProbe as LinearProbe
    from ultragray.geometry.probe import PhasedProbe as PhasedProbe
    from ultragray.geometry.probe import Probe as Probe
    from ultragray.geometry.probe import RadialProbe as RadialProbe
    from ultragray.geometry.probe import SteeredProbe as SteeredProbe
    from ultragray.learn.localization.search import Tracker as Tracker
    from ultragray.learn.localization.search import localize as localize
    from ultragray.learn.localization.settings import Localization as Localization
    from ultragray.learn.planning.search import plan_views as plan_views
    from ultragray.learn.planning.settings import PlanSettings as PlanSettings
    from ultragray.learn.planning.settings import ViewPlan as ViewPlan
    from ultragray.rendering.frames import Frames as Frames
    from ultragray.rendering.frames import render as render
    from ultragray.scene.gaussians import GaussianScene as GaussianScene
    from ultragray.scene.info import SceneHeader as SceneHeader
    from ultragray.scene.info import SceneInfo as SceneInfo
    from ultragray.scene.info import read_header as read_header

_MODULES = {
    "errors": ("UltragrayError",),
    "geometry.pose": ("check_poses", "pose_from_position_quaternion", "quaternion_from_pose"),
    "geometry.probe": (
        "ConvexProbe",
        "ElevationBeam",
        "LinearProbe",
        "PhasedProbe",
        "Probe",
        "RadialProbe",
        "SteeredProbe",
    ),
    "learn.localization.search": ("Tracker", "localize"),
    "learn.localization.settings": ("Localization",),
    "learn.planning.search": ("plan_views",),
    "learn.planning.settings": ("PlanSettings", "ViewPlan"),
    "rendering.frames": ("Frames", "render"),
    "scene.gaussians": ("GaussianScene",),
    "scene.info": ("SceneHeader", "SceneInfo", "read_header"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    """One of the names above, or a module of this package."""
    if name in _MODULE_OF:
        value = getattr(importlib.import_module(f".{_MODULE_OF[name]}", __name__), name)
        globals()[name] = value
        return value
    if not name.startswith("_") and find_spec(f".{name}", __name__) is not None:
        return importlib.import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
