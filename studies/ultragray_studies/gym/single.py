"""One environment, by gymnasium's API: `vector` with a single probe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode

from ultragray.errors import InvalidArgument
from ultragray_studies.gym.vector import RENDER_MODES, Scene, UltragrayVectorEnv


class UltragrayEnv(gymnasium.Env[Any, npt.NDArray[np.float32]]):
    """A task in a scene. Observations and actions are rows of those of UltragrayVectorEnv, in NumPy."""

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 25}  # noqa: RUF012  # as gymnasium declares it

    def __init__(self, scene: Scene, goal: Any = None, *, render_mode: str | None = None, **arguments: Any) -> None:
        """`arguments` are `task`, `probe` and the fields of ScanSettings. Raises what UltragrayVectorEnv raises."""
        single: dict[str, Any] = {
            "autoreset_mode": AutoresetMode.DISABLED,
            "as_numpy": True,
            "render_mode": render_mode,
        }
        self._only = UltragrayVectorEnv(1, scene, goal, **single, **arguments)
        self.render_mode = render_mode
        self.settings, self.goal = self._only.settings, self._only.tasks[0].goal
        self.action_space = self._only.single_action_space
        self.observation_space = self._only.single_observation_space

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode at a random pose about where the task starts, or at `options["pose"]`, [4, 4] mm.

        Raises InvalidPose, and InvalidArgument for another option and for a pose out of the reach of the task.
        """
        super().reset(seed=seed)
        self._only.randoms[0] = self.np_random
        observations, infos = self._only.reset(options=None if options is None else dict(options))
        return _first(observations), _info(infos)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Moves the probe. Raises InvalidArgument for an action that is not as many finite numbers as it should be."""
        try:
            actions = np.asarray(action, np.float64)[None]
        except (TypeError, ValueError):
            raise InvalidArgument(
                f"an action must be finite numbers from -1 to 1, got {action!r}", field="action"
            ) from None
        observations, rewards, terminated, _, infos = self._only.step(actions)
        return _first(observations), float(rewards[0]), bool(terminated[0]), False, _info(infos)

    def render(self) -> Any:
        """The frame, and beside it that of the goal where there is one, [H, 2·W, 3]."""
        pictures = self._only.render()
        return None if pictures is None else pictures[0]


def _first(observations: Any) -> Any:
    if isinstance(observations, dict):
        return {name: values[0] for name, values in observations.items()}
    return observations[0]


def _info(infos: Mapping[str, Any]) -> dict[str, Any]:
    """What the vector environment tells of its only one, plain numbers where it is one."""
    own = {name: values[0] for name, values in infos.items() if not name.startswith("_")}
    return {name: value if value.ndim else value.item() for name, value in own.items()}
