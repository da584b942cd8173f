"""Environments for gymnasium, on scenes in the same process: the extra `gym`. Importing this registers them.

import gymnasium
import ultragray_studies.gym

env = gymnasium.make("ultragray/StandardPlane-v0", scene="scene.ugr")
"""

from __future__ import annotations

from ultragray.installation import missing_extra
from ultragray_studies.gym.standard_plane import StandardPlaneEnv, StandardPlaneSettings

try:
    import gymnasium
except ImportError as error:
    raise missing_extra(error, "ultragray_studies.gym") from None


__all__ = ["STANDARD_PLANE", "StandardPlaneEnv", "StandardPlaneSettings"]

STANDARD_PLANE = "ultragray/StandardPlane-v0"
MOST_STEPS = 200  # of an episode made by its name

if STANDARD_PLANE not in gymnasium.registry:
    gymnasium.register(
        STANDARD_PLANE,
        entry_point=f"{__name__}.standard_plane:StandardPlaneEnv",
        max_episode_steps=MOST_STEPS,
    )
