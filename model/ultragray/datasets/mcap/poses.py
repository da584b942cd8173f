"""Poses at the times of images: from the tracked poses before and after, position linear, orientation by slerp."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ultragray.datasets.mcap.messages import StoredMessage, time_of
from ultragray.datasets.plus.transforms import TransformName, find_path
from ultragray.datasets.sweep import IntArray
from ultragray.errors import DatasetInvalid, InvalidArgument, InvalidPose
from ultragray.interchange.ros_fields import TRANSFORM, TRANSFORMS
from ultragray.interchange.ros_messages import POSE
from ultragray.interchange.ros_poses import pose_of_parts
from ultragray.probe import FloatArray
from ultragray.samplers.rotations import blended

TF = "/tf"
MAX_GAP_NS = 200_000_000  # a hand that moves on goes another way within a longer time

BoolArray: TypeAlias = npt.NDArray[np.bool_]
_Stamped: TypeAlias = tuple[int, Any, Any]  # time in ns, position in metres, orientation


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Poses over time, ascending; one that is fixed has no times."""

    times_ns: IntArray  # [P], of a fixed one [0]
    poses: FloatArray  # [P, 4, 4] mm, of a fixed one [1, 4, 4]

    def fixed(self) -> PoseTrack:
        """The last pose alone, for all times."""
        return PoseTrack(self.times_ns[:0], self.poses[-1:])

    def at(self, times_ns: IntArray) -> tuple[FloatArray, BoolArray]:  # [F] -> [F, 4, 4], [F]
        """The pose at each time, and whether it is known: at the time of a pose, or between two at most 0.2 s apart."""
        if not len(self.times_ns):
            return np.repeat(self.poses, len(times_ns), axis=0), np.ones(len(times_ns), bool)
        after = np.minimum(np.searchsorted(self.times_ns, times_ns), len(self.times_ns) - 1)
        exact = self.times_ns[after] == times_ns
        before = np.where(exact, after, np.maximum(after - 1, 0))
        gaps = self.times_ns[after] - self.times_ns[before]
        known = exact | ((self.times_ns[before] < times_ns) & (times_ns < self.times_ns[after]) & (gaps <= MAX_GAP_NS))
        shares = np.where(known, (times_ns - self.times_ns[before]) / np.maximum(gaps, 1), 0.0)
        first, second = self.poses[before], self.poses[after]
        found = first.copy()
        found[:, :3, :3] = blended(first[:, :3, :3], second[:, :3, :3], shares)
        found[:, :3, 3] += shares[:, None] * (second[:, :3, 3] - first[:, :3, 3])
        return found, known


@dataclass(frozen=True)
class Way:
    """Poses over time, step by step from the probe's frame to the one that they are in."""

    name: str  # the topic, or the frames of tf, such as probeTobase
    steps: tuple[tuple[PoseTrack, bool], ...]  # True: inverted
    lost: int  # poses that are none, such as of a tracker that lost the probe

    def at(self, times_ns: IntArray) -> tuple[FloatArray, BoolArray]:  # [F] -> [F, 4, 4], [F]
        """The pose at each time, and whether it is known."""
        poses, known = np.tile(np.eye(4), (len(times_ns), 1, 1)), np.ones(len(times_ns), bool)
        for track, is_inverted in self.steps:
            found, is_known = track.at(times_ns)
            poses = (np.linalg.inv(found) if is_inverted else found) @ poses
            known &= is_known
        return poses, known

    @property
    def span_ns(self) -> tuple[int, int]:
        """The times between which there are poses."""
        moving = [track.times_ns for track, _ in self.steps if len(track.times_ns)]
        return max(int(times[0]) for times in moving), min(int(times[-1]) for times in moving)


class TrackedPoses:
    """The poses of a file by topic, and the transforms of tf by their frames."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._poses: dict[str, list[_Stamped]] = {}
        self._tracked: dict[str, set[TransformName]] = {}  # what the transforms of a topic are of, by topic
        self._transforms: dict[TransformName, list[_Stamped]] = {}  # from child to parent
        self._fixed: dict[TransformName, _Stamped] = {}

    @property
    def topics(self) -> list[str]:
        """Those that poses may be taken from; `/tf` stands for all transforms."""
        return sorted(self._poses) + ([TF] if self._transforms else [])

    def take(self, message: StoredMessage) -> None:
        """Keep the poses of a message; other messages are passed over. Raises DatasetInvalid where it is damaged."""
        if message.kind == POSE:
            stamped = message.decode()
            parts = stamped.pose.position, stamped.pose.orientation
            self._poses.setdefault(message.topic, []).append((time_of(stamped.header, message.log_time_ns), *parts))
        elif message.kind == TRANSFORM:
            transform = message.decode()
            self._poses.setdefault(message.topic, []).append(_stamped(transform, message))
            self._tracked.setdefault(message.topic, set()).add(_name_of(transform))
        elif message.kind == TRANSFORMS:
            for transform in message.decode().transforms:
                name = _name_of(transform)
                if message.topic.endswith("_static"):
                    self._fixed[name] = _stamped(transform, message)
                else:
                    self._transforms.setdefault(name, []).append(_stamped(transform, message))

    def way(self, topic: str, frame: str, transform: str | None) -> Way:
        """The poses of a topic, or of tf those between two frames that `transform` names, such as probeTobase.

        None: from `frame`, the one of the images, as far up as tf leads. Raises DatasetInvalid where there is no such
        way or all of its poses are none, InvalidArgument for a transform of a topic and for frames that there are not.
        """
        if topic == TF:
            return self._way_of_transforms(frame, transform)
        if transform is not None:
            raise InvalidArgument(f"transform is for the poses of {TF}, these are of {topic}", field="transform")
        if len(tracked := self._tracked.get(topic, set())) > 1:
            names = ", ".join(sorted(map("To".join, tracked)))
            raise DatasetInvalid(
                f"{self._path}: {topic} must tell the poses of one thing, it tells those of {len(tracked)}: {names}; "
                f"record them as tf, or on topics of their own"
            )
        track, lost = self._track(self._poses[topic], topic)
        return Way(topic, ((track, False),), lost)

    def _way_of_transforms(self, frame: str, transform: str | None) -> Way:
        names = {*self._transforms, *self._fixed}
        frames = sorted({one for name in names for one in name})
        example, known = "To".join(min(names)), ", ".join(frames)
        if transform is None:
            start, goal = frame, _root(frame, dict(sorted(names)))
            if goal == start:
                raise DatasetInvalid(
                    f"{self._path}: tf leads nowhere from the frame of the images, {frame!r}: say with transform "
                    f"between which frames of tf, such as {example}; there are {known}"
                )
        else:
            pairs = [(a, b) for a in frames for b in frames if a != b and f"{a}To{b}" == transform]
            if not pairs:
                raise InvalidArgument(
                    f"transform must be two frames of tf, such as {example}; there are {known}, got {transform[:80]!r}",
                    field="transform",
                )
            start, goal = pairs[0]
        way = find_path(names, start, goal)
        if way is None or all(name not in self._transforms for name, _ in way):
            raise DatasetInvalid(f"{self._path}: no tracked transforms of tf lead from {start} to {goal}")
        steps, lost = [], 0
        for name, is_inverted in way:
            is_tracked = name in self._transforms
            stamped = self._transforms[name] if is_tracked else [self._fixed[name]]
            track, lost_here = self._track(stamped, "To".join(name))
            steps.append((track if is_tracked else track.fixed(), is_inverted))
            lost += lost_here
        return Way(f"{start}To{goal}", tuple(steps), lost)

    def _track(self, stamped: Sequence[_Stamped], name: str) -> tuple[PoseTrack, int]:
        """The poses over time, and how many are none."""
        found: dict[int, FloatArray] = {}
        problems: list[str] = []
        for time_ns, position, turn in stamped:
            try:
                found[time_ns] = pose_of_parts(position, turn, field="a pose")
            except InvalidPose as error:
                problems.append(error.detail)
        if not found:
            raise DatasetInvalid(f"{self._path}: none of the {len(stamped)} poses of {name} is one: {problems[0]}")
        times = sorted(found)
        track = PoseTrack(np.array(times, np.int64), np.array([found[time_ns] for time_ns in times]))
        return track, len({time_ns for time_ns, _, _ in stamped} - set(times))


def _name_of(transform: Any) -> TransformName:
    """Child and parent."""
    return transform.child_frame_id.lstrip("/"), transform.header.frame_id.lstrip("/")


def _stamped(transform: Any, message: StoredMessage) -> _Stamped:
    parts = transform.transform.translation, transform.transform.rotation
    return time_of(transform.header, message.log_time_ns), *parts


def _root(frame: str, parents: Mapping[str, str]) -> str:
    """The frame that tf leads up to from this one, by the parent of each."""
    seen = {frame}
    while (parent := parents.get(frame)) is not None and parent not in seen:
        seen.add(parent)
        frame = parent
    return frame
