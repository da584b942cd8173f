"""Environments for gymnasium, on scenes in the same process: the extra `gym`. Importing this registers them.

import gymnasium
import ultragray_studies.gym

env = gymnasium.make("ultragray/StandardPlane-v0", scene="scene.ugr")
"""

from __future__ import annotations

from ultragray.errors import ExtraMissing

try:
    import gymnasium
except ImportError:
    advice = "pip install 'ultragray-studies[gym]'"
    raise ExtraMissing(f"ultragray_studies.gym needs gymnasium, which is not installed: {advice}") from None

from ultragray_studies.gym.standard_plane import StandardPlaneEnv, StandardPlaneSettings

__all__ = ["STANDARD_PLANE", "StandardPlaneEnv", "StandardPlaneSettings"]

STANDARD_PLANE = "ultragray/StandardPlane-v0"
MOST_STEPS = 200  # of an episode made by its name

if STANDARD_PLANE not in gymnasium.registry:
    gymnasium.register(
        STANDARD_PLANE,
        entry_point=f"{__name__}.standard_plane:StandardPlaneEnv",
        max_episode_steps=MOST_STEPS,
    )
