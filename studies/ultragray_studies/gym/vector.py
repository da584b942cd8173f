"""Many environments in one process, by gymnasium's vector API: probes are moved, and frames rendered, in batches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from ultragray.errors import InvalidArgument
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import BoolArray, FloatArray, Probe
from ultragray.scene.gaussians import GaussianScene
from ultragray_studies.gym.scan import LowConfidence, ScanSettings, Site, goal_of, moved
from ultragray_studies.gym.tasks import StandardPlane, Task, TaskName

Scene = GaussianScene | str | Path
_POSE_NUMBERS = 12
RENDER_MODES = ("rgb_array",)


class UltragrayVectorEnv(VectorEnv[Any, Any, Any]):
    """`num_envs` environments, on one scene or on several: environment i is on scene i modulo their number.

    Observation: frames, uint8 [N, H, W, 1]; with `with_pose` a dict of `frame` and `pose`, float32 [N, 12]: position in
    mm and rotation, row by row, of each probe in its own frame at the start of its episode, as odometry tells it.
    Action: float32 [N, 6], clipped to −1 to 1: a shift along the probe's lateral, elevation and axial axis, in
    `step_mm`, and a turn about them through the middle of the face, in `step_deg`; a task may take further numbers.
    A step that would leave `reach_mm` or `reach_deg` of where the task is, is not made.
    Observations, rewards and ends are torch tensors on the scene's device, NumPy arrays with `as_numpy`. Actions may be
    either, wherever they are. Rewards and ends are those of the task (`ultragray_studies.gym.tasks`).
    """

    def __init__(
        self,
        num_envs: int,
        scene: Scene | Sequence[Scene],
        goal: Any = None,  # [4, 4] mm, or the number of a training view
        *,
        task: TaskName | str = TaskName.STANDARD_PLANE,
        probe: Probe | None = None,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        as_numpy: bool = False,
        **settings: Any,
    ) -> None:
        """`scene`: or its file, or several, which must be on one device. `goal` None: the training view in the middle
        of each sweep. `probe` None: each scene's own. `settings` are the fields of ScanSettings.

        Raises InvalidArgument, InvalidPose, InvalidProbe, SceneFileInvalid.
        """
        if num_envs < 1:
            raise InvalidArgument(f"num_envs must be at least 1, got {num_envs}", field="num_envs")
        if render_mode not in (None, *RENDER_MODES):
            raise InvalidArgument(f"render_mode must be rgb_array or None, got {render_mode!r}", field="render_mode")
        try:
            self._kind = Task.members[TaskName(task)]
        except ValueError:
            names = ", ".join(name.value for name in TaskName)
            raise InvalidArgument(f"task must be one of {names}, got {task!r}", field="task") from None
        self.num_envs, self.render_mode = num_envs, render_mode
        self.settings = ScanSettings(**settings)
        self._mode, self._most_steps, self._as_numpy = AutoresetMode(autoreset_mode), max_episode_steps, as_numpy
        self.metadata = {"render_modes": list(RENDER_MODES), "render_fps": 25, "autoreset_mode": self._mode}
        sources = [scene] if isinstance(scene, (GaussianScene, str, Path)) else list(scene)
        if not sources:
            raise InvalidArgument("scene must be a scene, its file, or some of them, got none", field="scene")
        scenes = [one if isinstance(one, GaussianScene) else GaussianScene.load(one) for one in sources]
        if len({one.means.device for one in scenes}) > 1:
            raise InvalidArgument("scenes must be on one device, which their frames stay on", field="scene")
        self._device = scenes[0].means.device
        numbers = np.arange(num_envs)
        self._members = [np.flatnonzero(numbers % len(scenes) == place) for place in range(min(len(scenes), num_envs))]
        self.tasks: list[Task] = [
            self._kind(Site(one, probe, self.settings), goal_of(one, goal), len(own))
            for one, own in zip(scenes, self._members, strict=False)
        ]
        self.single_action_space = spaces.Box(-1.0, 1.0, (self._kind.action_size,), np.float32)
        self.single_observation_space = self._space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.randoms: list[np.random.Generator] = [np.random.default_rng() for _ in numbers]
        self._poses = np.broadcast_to(np.eye(4), (num_envs, 4, 4)).copy()
        self._starts, self._steps = self._poses.copy(), np.zeros(num_envs, np.int64)
        self._ended = np.ones(num_envs, np.bool_)
        size = num_envs, self.settings.height, self.settings.width
        self._frames = torch.zeros(size, dtype=torch.uint8, device=self._device)

    def _space(self) -> spaces.Space[Any]:
        frame = spaces.Box(0, 255, (self.settings.height, self.settings.width, 1), np.uint8)
        if not self.settings.with_pose:
            return frame
        most = np.ones(_POSE_NUMBERS, np.float32)
        most[:3] = max(
            np.ptp(task.posts[:, :3, 3], axis=0).max()
            + 2.0 * self.settings.reach_mm
            + 2.0 * abs(task.site.probe.pivot_depth_mm)
            for task in self.tasks
        )
        return spaces.Dict({"frame": frame, "pose": spaces.Box(-most, most)})

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins episodes at random poses about where their task starts, or at `options["pose"]`, [N, 4, 4] mm.

        `seed`: environment i has seed + i, or its own of a sequence. `options["reset_mask"]` [N]: these alone begin
        anew. Where contact is judged, starts are drawn until one has START_CONTACT. Raises InvalidPose, and
        InvalidArgument for another option and for a pose out of the reach of the task.
        """
        if seed is not None:
            seeds = [seed + number for number in range(self.num_envs)] if isinstance(seed, int) else list(seed)
            if len(seeds) != self.num_envs:
                raise InvalidArgument(f"seed must be one, or {self.num_envs}, got {len(seeds)}", field="seed")
            super().reset(seed=seeds[0])
            for number, own in enumerate(seeds):
                if own is not None:
                    self.randoms[number] = gymnasium.utils.seeding.np_random(own)[0]
        rest = dict(options or {})
        poses, mask = rest.pop("pose", None), rest.pop("reset_mask", None)
        if rest:
            raise InvalidArgument(
                f"options may hold pose and reset_mask, got {', '.join(map(str, rest))}", field="options"
            )
        which = self._mask(mask)
        checked = None if poses is None else self._checked_starts(poses)
        self._begin(which, checked)
        _, _, infos = self._look(which)
        return self._observed(), self._infos(infos, which)

    def _mask(self, mask: Any) -> BoolArray:  # [N]
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        which = np.asarray(mask.cpu() if isinstance(mask, Tensor) else mask)
        if which.shape != (self.num_envs,) or which.dtype != np.bool_ or not which.any():
            raise InvalidArgument(
                f"options.reset_mask must be {self.num_envs} booleans, one true at least, got {mask!r}",
                field="options.reset_mask",
            )
        return which

    def _checked_starts(self, poses: Any) -> FloatArray:  # [N, 4, 4]
        checked = check_poses(poses, field="options.pose")
        if len(checked) != self.num_envs:
            raise InvalidArgument(
                f"options.pose must be {self.num_envs} poses, got {len(checked)}", field="options.pose"
            )
        in_reach, away_mm, turned_deg = self._in_reach(checked)
        if not in_reach.all():
            first = int(np.argmin(in_reach))
            raise InvalidArgument(
                f"options.pose must be within {self.settings.reach_mm:g} mm and {self.settings.reach_deg:g}° of the "
                f"goal, got {away_mm[first]:.1f} mm and {turned_deg[first]:.1f}°: with a larger start_mm or start_deg "
                "it may be farther off",
                field="options.pose",
            )
        return checked

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Moves the probes. Raises InvalidArgument for actions that are not N rows of finite numbers.

        An environment whose episode has ended begins another: in the next step, whose action then counts for nothing,
        in the same step (`infos["final_obs"]` and `infos["final_info"]` are of the one that ended), or, with autoreset
        disabled, when it is reset.
        """
        clipped = np.clip(_finite(actions, (self.num_envs, self._kind.action_size)), -1.0, 1.0)
        fresh = self._ended & (self._mode is AutoresetMode.NEXT_STEP)
        everywhere = np.ones(self.num_envs, np.bool_)
        if fresh.any():
            self._begin(fresh, None)
        self._move(~fresh, clipped)
        self._steps[~fresh] += 1
        rewards, terminated, infos = self._look(everywhere)
        rewards[torch.from_numpy(fresh).to(self._device)] = 0.0
        terminated &= ~fresh
        truncated = np.zeros_like(terminated) if self._most_steps is None else self._steps >= self._most_steps
        self._ended = terminated | truncated
        masked_infos = self._infos(infos, everywhere)
        if self._mode is AutoresetMode.SAME_STEP and self._ended.any():
            ended, final, ending = self._ended.copy(), self._observed(), self._infos(infos, self._ended)
            self._begin(ended, None)
            _, _, new_infos = self._look(ended)
            masked_infos = {
                **self._infos({name: _replaced(infos[name], ended, new_infos[name]) for name in infos}, everywhere),
                **{"final_obs": final, "_final_obs": ended, "final_info": ending, "_final_info": ended},
            }
        return self._observed(), self._out(rewards), self._out(terminated), self._out(truncated), masked_infos

    def render(self) -> tuple[Any, ...] | None:
        """Of each environment the frame, and where its task is a standard plane beside it that of the goal, RGB."""
        if self.render_mode is None:
            return None
        pictures = []
        for number, frame in enumerate(self._frames.cpu().numpy()):
            task = self.tasks[number % len(self.tasks)]
            parts = [frame, *([task.frame.cpu().numpy()] if isinstance(task, StandardPlane) else [])]
            pictures.append(np.repeat(np.concatenate(parts, axis=1)[..., None], 3, axis=2))
        return tuple(pictures)

    def _begin(self, which: BoolArray, poses: FloatArray | None) -> None:  # [N], [N, 4, 4]
        for task, own in zip(self.tasks, self._members, strict=True):
            mask = which[own]
            if mask.any():
                numbers = own[mask]
                if poses is None:
                    randoms = [self.randoms[number] for number in numbers]
                    self._poses[numbers] = task.site.random_starts(task.posts[0], randoms)
                else:
                    self._poses[numbers] = poses[numbers]
                task.begin(mask)
        self._starts[which], self._steps[which], self._ended[which] = self._poses[which], 0, False

    def _move(self, which: BoolArray, actions: FloatArray) -> None:  # [N], [N, A]
        for task, own in zip(self.tasks, self._members, strict=True):
            pivot_mm = task.site.probe.pivot_depth_mm
            shifts, turns = actions[own, :3] * self.settings.step_mm, actions[own, 3:6] * self.settings.step_deg
            new_poses = moved(self._poses[own], shifts, turns, pivot_mm)
            allowed = which[own] & self._in_reach_of(task, new_poses)[0]
            self._poses[own[allowed]] = check_poses(new_poses[allowed])  # rounding does not add up
            task.act(which[own], actions[own, 6:])

    def _in_reach(self, poses: FloatArray) -> tuple[BoolArray, FloatArray, FloatArray]:  # [N, 4, 4] -> [N] each
        in_reach, away_mm, turned_deg = np.zeros(len(poses), np.bool_), np.zeros(len(poses)), np.zeros(len(poses))
        for task, own in zip(self.tasks, self._members, strict=True):
            in_reach[own], away_mm[own], turned_deg[own] = self._in_reach_of(task, poses[own])
        return in_reach, away_mm, turned_deg

    def _in_reach_of(self, task: Task, poses: FloatArray) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Whether poses are near enough to one of the posts of a task, and distance and angle to the nearest."""
        away_mm, turned_deg = task.site.between(poses, task.posts)
        near = (away_mm <= self.settings.reach_mm) & (turned_deg <= self.settings.reach_deg)
        rows, nearest = np.arange(len(poses)), away_mm.argmin(axis=1)
        return np.any(near, axis=1), away_mm[rows, nearest], turned_deg[rows, nearest]

    def _look(self, which: BoolArray) -> tuple[Tensor, BoolArray, dict[str, Any]]:
        """Renders what the environments of a mask [N] see, and what it is worth; what is told is [N, ...]."""
        rewards, done = torch.zeros(self.num_envs, device=self._device), np.zeros(self.num_envs, np.bool_)
        infos: dict[str, Any] = {}
        for task, own in zip(self.tasks, self._members, strict=True):
            mask = which[own]
            if not mask.any():
                continue
            places = own[mask]
            poses = self._poses[places]
            view = task.site.look(poses, task.tools(mask))
            judged = task.judge(mask, view)
            at = torch.from_numpy(places).to(self._device)
            whole = len(at) == self.num_envs
            self._frames = view.frames if whole else self._frames.index_copy(0, at, view.frames)
            away_mm, turned_deg = (values[:, 0] for values in task.site.between(poses, task.goal[None]))
            figures = {"contact_share": view.contact_shares, "distance_mm": away_mm, "angle_deg": turned_deg}
            worth = judged.rewards
            if view.confidences is not None:
                figures["confidence"] = view.confidences
                if self.settings.low_confidence is LowConfidence.PENALTY:
                    least = self.settings.min_confidence
                    lack = np.maximum(1.0 - view.confidences / least, 0.0) if least else np.zeros(len(places))
                    worth = worth - torch.from_numpy(lack).float().to(self._device)
            rewards[at], done[places] = worth, judged.is_done
            for name, values in {**figures, **judged.infos, "pose": poses}.items():
                if name not in infos:
                    empty = values.new_zeros if isinstance(values, Tensor) else np.zeros
                    infos[name] = empty((self.num_envs, *values.shape[1:]))
                infos[name][at if isinstance(values, Tensor) else places] = values
        return rewards, done, infos

    def _observed(self) -> Any:
        frames = self._out(self._frames[..., None])  # a step makes others of them
        if not self.settings.with_pose:
            return frames
        moved_by = np.linalg.inv(self._starts) @ self._poses
        poses = np.concatenate([moved_by[:, :3, 3], moved_by[:, :3, :3].reshape(-1, 9)], axis=1)
        space: Any = self.single_observation_space
        most = space["pose"].high
        return {"frame": frames, "pose": self._out(np.clip(poses, -most, most).astype(np.float32))}

    def _out(self, values: Any) -> Any:
        """As callers want it."""
        if self._as_numpy:
            return values.cpu().numpy() if isinstance(values, Tensor) else values
        return values if isinstance(values, Tensor) else torch.from_numpy(np.ascontiguousarray(values)).to(self._device)

    def _infos(self, infos: Mapping[str, Any], which: BoolArray) -> dict[str, Any]:
        """Infos as gymnasium has them: beside each value a mask of the environments that it is of."""
        arrays = {name: self._out(values) if isinstance(values, Tensor) else values for name, values in infos.items()}
        return {**arrays, **{f"_{name}": which.copy() for name in arrays}}


def _replaced(values: Any, which: BoolArray, others: Any) -> Any:  # [N, ...], [N], [N, ...]
    if isinstance(values, Tensor):
        return torch.where(torch.from_numpy(which).to(values.device), others, values)
    return np.where(which.reshape(-1, *[1] * (values.ndim - 1)), others, values)


def _finite(actions: Any, shape: tuple[int, int]) -> FloatArray:
    """Raises InvalidArgument."""
    try:
        array = np.asarray(actions.detach().cpu() if isinstance(actions, Tensor) else actions, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise InvalidArgument(
            f"actions must be {shape[0]} times {shape[1]} finite numbers from -1 to 1, got {actions!r}", field="action"
        )
    return array
