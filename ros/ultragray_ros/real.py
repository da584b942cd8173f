"""Real images of a probe and its poses, which come on their own, on their way into a recording. Free of ROS."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ultragray_client import Client, Placement, Probe, Quaternion, RealFrame, RecordingSettings
from ultragray_client.errors import ClientError, InvalidPose

MOST_IMAGES, MOST_POSES = 64, 1024  # that wait; older ones are lost
MOST_GAP_S = 0.2  # between the poses before and after an image
CLOSE_S = 5.0  # for what came last


class _Stamped(NamedTuple):
    stamp_ns: int
    pose: Placement


class _Image(NamedTuple):
    number: int  # of those that came
    stamp_ns: int
    pixels: npt.NDArray[np.uint8]  # [H, W]


class RealFrames:
    """A thread that records images, each at the pose of its stamp, between the poses before and after it.

    An image waits for a pose that is stamped later. `tell` gets what goes wrong: images without such poses, frames that
    are refused, a service that is away; the next image goes on. It is called by any thread.
    """

    def __init__(self, client: Client, name: str, probe: Probe, *, tell: Callable[[ClientError], None]) -> None:
        self._client, self._name, self._probe, self._tell = client, name, probe, tell
        self._poses: deque[_Stamped] = deque(maxlen=MOST_POSES)
        self._images: deque[_Image] = deque(maxlen=MOST_IMAGES)
        self._changed = threading.Condition()
        self._count = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="ultragray-real", daemon=True)
        self._thread.start()

    def pose(self, stamp_ns: int, pose: Placement) -> None:
        """Take a pose of the probe."""
        with self._changed:
            if self._poses and stamp_ns <= self._poses[-1].stamp_ns:  # the clock was set, or a bag begins again
                self._poses.clear()
            self._poses.append(_Stamped(stamp_ns, pose))
            self._changed.notify()

    def image(self, stamp_ns: int, pixels: npt.NDArray[np.uint8]) -> None:  # [H, W]
        """Take an image: rows along depth, columns across scan lines, not scan-converted."""
        with self._changed:
            self._images.append(_Image(self._count, stamp_ns, pixels))
            self._count += 1
            self._changed.notify()

    def close(self) -> None:
        """Record what has its pose, and end; the recording stays open."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        while (first := self._next()) is not None:
            try:
                height, width = np.shape(first.image)
                settings = RecordingSettings(self._probe, image_height=height, image_width=width)
                begun = self._client.recordings.begin(self._name, settings)
                for answer in self._client.recordings.record(self._name, self._from(first, begun.next_number)):
                    if answer.error is not None:
                        self._tell(answer.error)
            except ClientError as error:
                self._tell(error)

    def _from(self, first: RealFrame, next_number: int) -> Iterator[RealFrame]:
        """Frames with their numbers in the recording: those that were lost are missing in it."""
        assert first.number is not None
        frame: RealFrame | None = first
        while frame is not None and frame.number is not None:
            yield replace(frame, number=next_number + frame.number - first.number)
            frame = self._next()

    def _next(self) -> RealFrame | None:
        """The next image with its pose; None when this is closed."""
        with self._changed:
            while True:
                while self._images and self._poses and self._images[0].stamp_ns <= self._poses[-1].stamp_ns:
                    image = self._images.popleft()
                    if (pose := self._pose_at(image.stamp_ns)) is not None:
                        return RealFrame(image.pixels, pose, image.stamp_ns / 1e9, image.number)
                    self._tell(InvalidPose(f"an image has no poses before and after it within {MOST_GAP_S:g} s"))
                if self._closed:
                    return None
                self._changed.wait()

    def _pose_at(self, stamp_ns: int) -> Placement | None:
        """Linear in the position and, as the poses are near to each other, in the quaternion."""
        place = bisect_left(self._poses, stamp_ns, key=lambda one: one.stamp_ns)
        after = self._poses[place]
        if after.stamp_ns == stamp_ns:
            return after.pose
        before = self._poses[place - 1]
        gap_ns = after.stamp_ns - before.stamp_ns
        if place == 0 or gap_ns > 1e9 * MOST_GAP_S:
            return None
        share = (stamp_ns - before.stamp_ns) / gap_ns
        (p, q), (other_p, other_q) = map(_numbers, (before.pose, after.pose))
        position = p + share * (other_p - p)
        turn = (1.0 - share) * q + share * np.copysign(1.0, q @ other_q) * other_q
        w, x, y, z = (turn / (np.linalg.norm(turn) or 1.0)).tolist()
        return Placement((position[0], position[1], position[2]), Quaternion(w=w, x=x, y=y, z=z))


def _numbers(pose: Placement) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:  # [3], [4]
    turn = pose.quaternion
    return np.array(pose.position_mm), np.array([turn.w, turn.x, turn.y, turn.z])
