"""A batch of any length as calls that the service takes, each from the first frame that is still missing."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable
from itertools import islice

from ultragray_proto.v1 import geometry_pb2, rendering_pb2

from ..errors import ClientError, TooManyPoses
from ..frames import Frame, frame_from_message
from ..geometry import PoseLike, pose_messages
from .connection import Conversation
from .retries import Retries

_POSES_PER_CALL = 256  # halved where the service takes fewer


class Batch(Conversation[Frame]):
    """The poses that wait for their frames."""

    def __init__(self, settings: rendering_pb2.RenderSettings, poses: Iterable[PoseLike]) -> None:
        self._settings = settings
        self._poses = pose_messages(poses)
        self._waiting: deque[geometry_pb2.Pose] = deque()
        self._first = 0  # sequence of the first that waits
        self._first_of_call = 0
        self._per_call = _POSES_PER_CALL

    def request(self) -> rendering_pb2.RenderBatchRequest | None:
        """The request for the next poses. Raises InvalidPose."""
        self._waiting.extend(islice(self._poses, max(self._per_call - len(self._waiting), 0)))
        if not self._waiting:
            return None
        self._first_of_call = self._first
        poses = islice(self._waiting, self._per_call)
        return rendering_pb2.RenderBatchRequest(settings=self._settings, poses=poses)

    def take(self, message: rendering_pb2.Frame) -> Frame:
        """The frame of the first pose that waits."""
        frame = frame_from_message(message, sequence=self._first)
        self._waiting.popleft()
        self._first += 1
        return frame

    def end_of_call(self) -> None:
        """A call brings no more than the frames of its own poses."""

    def pause_s(self, error: ClientError, retries: Retries) -> float:
        """The seconds to wait; asks for fewer poses at once where they were too many."""
        asked = min(self._per_call, len(self._waiting))
        if isinstance(error, TooManyPoses) and asked > 1:
            self._per_call = asked // 2
            return 0.0
        return retries.pause_s(self._renumbered(error))

    def _renumbered(self, error: ClientError) -> ClientError:
        """The error with the index in the whole batch, where it names a pose of one call."""
        named = re.match(r"pose$|poses\[(\d+)\]", error.field or "")
        if named is None:
            return error
        # One that is found while frames come, in their order, is told as that of a single pose.
        index = self._first if named[1] is None else self._first_of_call + int(named[1])
        detail, field = (text.replace(named[0], f"poses[{index}]", 1) for text in (error.detail, error.field or ""))
        return type(error)(detail, reason=error.reason, field=field, retry_after_s=error.retry_after_s)
