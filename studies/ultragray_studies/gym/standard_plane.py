"""Settings of the environments. Free of torch and of gymnasium."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument, InvalidImageSize
from ultragray.geometry.image_size import MAX_IMAGE_SIDE
from ultragray.geometry.pose import check_poses, rotation_angles_deg
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.geometry.rotations import about_axes, random_directions, rotations_of
from ultragray.rendering.frames import render, touch_of
from ultragray.rendering.pixels import to_uint8
from ultragray.rendering.settings import Contact
from ultragray.scene.gaussians import GaussianScene

_ROOM_MM, _ROOM_DEG = 10.0, 10.0  # beyond twice the farthest start


@dataclass(frozen=True, kw_only=True)
class StandardPlaneSettings(Contract):
    """Settings of the environment StandardPlane-v0. Raises InvalidArgument."""

    height: int = described("Depth samples.", 128, low=8, high=MAX_IMAGE_SIDE, error=InvalidImageSize)
    width: int = described("Scan lines.", 128, low=8, high=MAX_IMAGE_SIDE, error=InvalidImageSize)
    start_mm: float = described("An episode begins at most so far from the goal.", 15.0, low=0.0, high=1000.0)
    start_deg: float = described("And turned by at most so much.", 15.0, low=0.0, high=90.0)
    step_mm: float = described("Largest shift of an action along each axis.", 2.0, above=0.0, high=100.0)
    step_deg: float = described("Largest turn of an action about each axis.", 2.0, above=0.0, high=45.0)
    reached_mm: float = described("So near to the goal, an episode ends.", 1.0, low=0.0, high=100.0)
    reached_deg: float = described("And turned from it by at most so much.", 2.0, low=0.0, high=90.0)
    contact: Contact | None = described(
        "air: scan lines whose face is off the skin are dark. pressure: and a face that is pressed in compresses the "
        "tissue. None: contact is assumed.",
        Contact.AIR,
    )
    with_pose: bool = described("Observe the pose beside the frame.", False)

    @property
    def reach_mm(self) -> float:
        """The farthest that the probe gets from the goal."""
        return 2.0 * self.start_mm + _ROOM_MM

    @property
    def reach_deg(self) -> float:
        """The most that it can be turned from the goal."""
        return min(2.0 * self.start_deg + _ROOM_DEG, 180.0)


# Motions of a probe in its own frame, about the middle of its face.


def moved(pose: FloatArray, shift_mm: FloatArray, turn_deg: FloatArray, pivot_mm: float) -> FloatArray:
    """A pose [4, 4] shifted along and turned about the probe's axes, [3] each: lateral, elevation, axial.

    A turn is an axis times an angle, about the point at depth `pivot_mm` on the probe's axis.
    """
    return _displaced(pose, shift_mm, rotations_of(np.radians(turn_deg)[None])[0], pivot_mm)


def random_motion(
    random: np.random.Generator, pose: FloatArray, most_mm: float, most_deg: float, pivot_mm: float
) -> FloatArray:
    """A pose [4, 4] shifted at random, uniform in a ball, and turned about a random axis by a uniform angle."""
    shift = random_directions(random, 1)[0] * most_mm * random.random() ** (1.0 / 3.0)
    turn = about_axes(random_directions(random, 1), np.radians(most_deg) * random.random(1))[0]
    return _displaced(pose, shift, turn, pivot_mm)


def _displaced(pose: FloatArray, shift_mm: FloatArray, rotation: FloatArray, pivot_mm: float) -> FloatArray:
    pivot = np.array([0.0, 0.0, pivot_mm])
    motion = np.eye(4)
    motion[:3, :3] = rotation
    motion[:3, 3] = shift_mm + pivot - rotation @ pivot
    displaced: FloatArray = pose @ motion
    return displaced


# How alike two frames are, as a reward: quick, and telling from afar.


ByteImage = npt.NDArray[np.uint8]
COARSE = 8  # pixels of a side that are averaged


class Target:
    """A frame that others are compared with."""

    def __init__(self, frame: ByteImage) -> None:  # [H, W]
        self._fine, self._coarse = _standard(frame), _standard(_coarse(frame))

    def similarity(self, frame: ByteImage) -> float:  # [H, W]
        """The mean of two correlations, from −1 to 1: of the frames, and of their means over 8x8 pixels.

        The first tells a frame that is the target's from one beside it, the second the way to it from some millimetres
        away. That of a frame without contrast, such as one without contact, is 0.
        """
        fine = float(np.vdot(self._fine, _standard(frame)))
        coarse = float(np.vdot(self._coarse, _standard(_coarse(frame))))
        return min(1.0, 0.5 * (fine + coarse))  # rounding could take it beyond


def _coarse(frame: ByteImage) -> npt.NDArray[np.float32]:  # [H, W] -> [H/8, W/8]
    size = max(1, frame.shape[1] // COARSE), max(1, frame.shape[0] // COARSE)
    means = cv2.resize(frame.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(means, np.float32)


def _standard(frame: npt.NDArray[np.generic]) -> npt.NDArray[np.float32]:
    """With a mean of 0 and a length of 1; 0 where it has no contrast."""
    centred = frame.astype(np.float32)
    centred -= centred.mean()
    length = float(np.linalg.norm(centred))
    return centred / length if length > 0.0 else centred


# StandardPlane-v0: find the view of a goal, by looking at the frames and moving the probe.


Observation = Any  # uint8 [H, W, 1], or a dict with `frame` and `pose`
START_CONTACT = 0.5  # the least share of contact at a start
REACHED_CONTACT = 0.9  # of the contact that the goal has, without which it is not reached
_MOST_STARTS = 200  # drawn for one that has it
_POSE_NUMBERS = 12


class StandardPlaneEnv(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """Scan to a standard plane.

    Observation: the frame, uint8 [H, W, 1]; with `with_pose` a dict of `frame` and `pose`, float32 [12]: position in mm
    and rotation, row by row, of the probe in its own frame at the start of the episode, as odometry tells it.
    Action: float32 [6], clipped to −1 to 1: a shift along the probe's lateral, elevation and axial axis, in
    `step_mm`, and a turn about them through the middle of the face, in `step_deg`.
    Reward: (similarity − 1) + (share of contact − 1), at most 0: similarity of the frame to that of the goal, from −1
    to 1, and the share of scan lines that have contact.
    An episode ends within `reached_mm` and `reached_deg` of the goal, with REACHED_CONTACT of its contact. A step that
    would leave `reach_mm` or `reach_deg` of the goal is not made.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012  # as gymnasium declares it

    def __init__(
        self,
        scene: GaussianScene | str | Path,
        goal: Any = None,  # [4, 4] mm, or the number of a training view
        *,
        probe: Probe | None = None,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        """`scene`: or its file. `goal` None: the training view in the middle of the sweep. `probe` None: the scene's.

        `settings` are the fields of StandardPlaneSettings. Raises InvalidArgument, InvalidPose, InvalidProbe,
        SceneFileInvalid.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InvalidArgument(f"render_mode must be rgb_array or None, got {render_mode!r}", field="render_mode")
        self.render_mode = render_mode
        self.settings = StandardPlaneSettings(**settings)
        self._scene = scene if isinstance(scene, GaussianScene) else GaussianScene.load(scene)
        self._probe = self._scene.info.probe_or(probe)
        self.goal = _goal_of(self._scene, goal)
        self._goal_frame, _ = self._frame(self.goal, contact=None)
        _, self._goal_contact = self._frame(self.goal, contact=self.settings.contact)
        if self._goal_frame.min() == self._goal_frame.max():
            raise InvalidArgument(
                "goal must be a pose, in mm, from which the scene shows something: its frame is black all over",
                field="goal",
            )
        self._target = Target(self._goal_frame)
        self.action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
        self.observation_space = self._space()
        self._start = self._pose = self.goal
        self._shown = self._goal_frame

    def _space(self) -> spaces.Space[Any]:
        frame = spaces.Box(0, 255, (self.settings.height, self.settings.width, 1), np.uint8)
        if not self.settings.with_pose:
            return frame
        most = np.ones(_POSE_NUMBERS, np.float32)
        most[:3] = self.settings.start_mm + self.settings.reach_mm + 2.0 * abs(self._probe.pivot_depth_mm)
        return spaces.Dict({"frame": frame, "pose": spaces.Box(-most, most)})

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode at a random pose around the goal, or at `options["pose"]`, [4, 4] mm.

        Where contact is judged, starts are drawn until one has START_CONTACT. Raises InvalidPose, and InvalidArgument
        for another option and for a pose out of the reach of the goal.
        """
        super().reset(seed=seed)
        given = dict(options or {})
        asked = given.pop("pose", None)
        if given:
            raise InvalidArgument(f"options may hold pose alone, got {', '.join(map(str, given))}", field="options")
        self._start = self._pose = self._random_start() if asked is None else self._start_at(asked)
        observation, info = self._look()
        return observation, info

    def _start_at(self, asked: Any) -> FloatArray:  # [4, 4]
        pose = _one_pose(asked, "options.pose")
        away_mm, turned_deg = self._off_goal(pose)
        if not self._is_in_reach(away_mm, turned_deg):
            raise InvalidArgument(
                f"options.pose must be within {self.settings.reach_mm:g} mm and {self.settings.reach_deg:g}° of the "
                f"goal, got {away_mm:.1f} mm and {turned_deg:.1f}°: with a larger start_mm or start_deg it may be "
                "farther off",
                field="options.pose",
            )
        return pose

    def _is_in_reach(self, away_mm: float, turned_deg: float) -> bool:
        return away_mm <= self.settings.reach_mm and turned_deg <= self.settings.reach_deg

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Moves the probe. Raises InvalidArgument for an action that is not six finite numbers."""
        given = _six_numbers(action)
        shift, turn = np.split(np.clip(given, -1.0, 1.0), 2)
        pivot_mm = self._probe.pivot_depth_mm
        asked = moved(self._pose, shift * self.settings.step_mm, turn * self.settings.step_deg, pivot_mm)
        if self._is_in_reach(*self._off_goal(asked)):
            self._pose = check_poses(asked)[0]  # rounding does not add up
        observation, info = self._look()
        reward = (info["similarity"] - 1.0) + (info["contact_share"] - 1.0)
        return observation, reward, self._is_reached(info), False, info

    def _is_reached(self, info: Mapping[str, Any]) -> bool:
        near = info["distance_mm"] <= self.settings.reached_mm and info["angle_deg"] <= self.settings.reached_deg
        return bool(near and info["contact_share"] >= REACHED_CONTACT * self._goal_contact)

    def render(self) -> ByteImage | None:  # [H, 2·W, 3]
        """The frame, and beside it that of the goal."""
        if self.render_mode is None:
            return None
        pair = np.concatenate([self._shown, self._goal_frame], axis=1)
        return np.repeat(pair[..., None], 3, axis=2)

    def _random_start(self) -> FloatArray:  # [4, 4]
        """Of all that were drawn, the first with enough contact, else the one with the most."""
        best, most = self.goal, -1.0
        for _ in range(_MOST_STARTS):
            pose = random_motion(
                self.np_random,
                self.goal,
                self.settings.start_mm,
                self.settings.start_deg,
                self._probe.pivot_depth_mm,
            )
            if self.settings.contact is None:
                return pose
            share = float(touch_of(self._scene, self._probe, pose, self.settings.width).shares[0])
            if share > most:
                best, most = pose, share
            if share >= START_CONTACT:
                break
        return best

    def _look(self) -> tuple[Observation, dict[str, Any]]:
        """The observation at the pose, and what is known beside it."""
        self._shown, contact_share = self._frame(self._pose, contact=self.settings.contact)
        distance_mm, angle_deg = self._off_goal(self._pose)
        info = {
            "similarity": self._target.similarity(self._shown),
            "contact_share": contact_share,
            "distance_mm": distance_mm,
            "angle_deg": angle_deg,
            "pose": self._pose.copy(),
        }
        frame = self._shown[..., None]
        if not self.settings.with_pose:
            return frame, info
        moved_by = np.linalg.inv(self._start) @ self._pose
        pose = np.concatenate([moved_by[:3, 3], moved_by[:3, :3].ravel()])
        return {"frame": frame, "pose": np.clip(pose, -self._limits, self._limits).astype(np.float32)}, info

    @property
    def _limits(self) -> FloatArray:  # [12]
        space: Any = self.observation_space
        return np.asarray(space["pose"].high, np.float64)

    def _frame(self, pose: FloatArray, *, contact: Contact | None) -> tuple[ByteImage, float]:  # [4, 4] -> [H, W]
        with torch.no_grad():
            frames = render(
                self._scene,
                self._probe,
                pose,
                height=self.settings.height,
                width=self.settings.width,
                outputs=("bmode",),
                contact=contact,
            )
        share = 1.0 if frames.touch is None else float(frames.touch.shares[0])
        return to_uint8(frames["bmode"][0].cpu().numpy()), share

    def _off_goal(self, pose: FloatArray) -> tuple[float, float]:
        """Distance of the middle of the face from that of the goal, mm, and the angle of the turn, degrees."""
        faces = [one @ _pivot(self._probe) for one in (pose, self.goal)]
        distance = np.linalg.norm(faces[0][:3, 3] - faces[1][:3, 3])
        return float(distance), float(rotation_angles_deg(pose[None], self.goal[None])[0, 0])


def _six_numbers(action: Any) -> FloatArray:  # [6]
    """Raises InvalidArgument."""
    try:
        given = np.asarray(action, np.float64)
    except (TypeError, ValueError):
        given = np.zeros(0)
    if given.shape != (6,) or not np.isfinite(given).all():
        raise InvalidArgument(f"an action must be 6 finite numbers from -1 to 1, got {action!r}", field="action")
    return given


def _pivot(probe: Probe) -> FloatArray:  # [4, 4]
    """Of the middle of the face in the probe's frame."""
    pivot = np.eye(4)
    pivot[2, 3] = probe.pivot_depth_mm
    return pivot


def _goal_of(scene: GaussianScene, goal: Any) -> FloatArray:  # [4, 4]
    """The pose of a goal. Raises InvalidArgument, InvalidPose."""
    views = scene.training_poses
    if goal is not None and (isinstance(goal, bool) or not isinstance(goal, (int, np.integer))):
        return _one_pose(goal, "goal")
    if not len(views):
        raise InvalidArgument("goal must be a pose: the scene holds no training poses", field="goal")
    number = len(views) // 2 if goal is None else int(goal)
    if not 0 <= number < len(views):
        raise InvalidArgument(
            f"goal must be a pose, or the number of a training view, 0 to {len(views) - 1}, got {number}", field="goal"
        )
    found: FloatArray = views[number].copy()
    return found


def _one_pose(pose: Any, field: str) -> FloatArray:  # [4, 4]
    """Raises InvalidPose."""
    exact = check_poses(pose, field=field)
    if len(exact) != 1:
        raise InvalidArgument(f"{field} must be one pose [4, 4], got {len(exact)}", field=field)
    one: FloatArray = exact[0]
    return one
