"""Environments for gymnasium, on scenes in the same process: the extra `gym`. Importing this registers them.

import gymnasium
import ultragray_studies.gym

env = gymnasium.make("ultragray/StandardPlane-v0", scene="scene.ugr")
many = gymnasium.make_vec("ultragray/StandardPlane-v0", num_envs=64, scene="scene.ugr")
"""

from __future__ import annotations

from ultragray.errors import ExtraMissing

try:
    import gymnasium
except ImportError:
    advice = "pip install 'ultragray-studies[gym]'"
    raise ExtraMissing(f"ultragray_studies.gym needs gymnasium, which is not installed: {advice}") from None

from ultragray_studies.gym.scan import ScanSettings
from ultragray_studies.gym.single import UltragrayEnv
from ultragray_studies.gym.tasks import TaskName
from ultragray_studies.gym.vector import UltragrayVectorEnv

__all__ = ["ENVIRONMENTS", "STANDARD_PLANE", "ScanSettings", "TaskName", "UltragrayEnv", "UltragrayVectorEnv"]

STANDARD_PLANE = "ultragray/StandardPlane-v0"
ENVIRONMENTS = {
    STANDARD_PLANE: TaskName.STANDARD_PLANE,
    "ultragray/Coverage-v0": TaskName.COVERAGE,
    "ultragray/Vessel-v0": TaskName.VESSEL,
    "ultragray/Needle-v0": TaskName.NEEDLE,
}
MOST_STEPS = 200  # of an episode made by its name

for _name, _task in ENVIRONMENTS.items():
    if _name not in gymnasium.registry:
        gymnasium.register(
            _name,
            entry_point=f"{__name__}.single:UltragrayEnv",
            vector_entry_point=f"{__name__}.vector:UltragrayVectorEnv",
            max_episode_steps=MOST_STEPS,
            kwargs={"task": _task.value},
        )
