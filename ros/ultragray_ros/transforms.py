"""Poses of the probe from the transforms of ROS, by tf2_ros of a ROS 2 installation: there is no wheel of it."""

from __future__ import annotations

from collections.abc import Callable

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.time import Time

from ultragray_client.errors import InvalidArgument

from .messages import stamped_pose
from .problems import Problems


class TransformedPoses:
    """Looks up the newest transform from the probe to the scene, so many times a second, and passes on each once."""

    def __init__(
        self,
        node: Node,
        scene_frame: str,
        probe_frame: str,
        *,
        rate_hz: float,
        take: Callable[[PoseStamped], None],
        problems: Problems,
    ) -> None:
        """Raises InvalidArgument where tf2_ros is not installed, or the rate is not above 0."""
        try:
            import tf2_ros
        except ImportError:
            raise InvalidArgument(
                "source must be pose where tf2_ros is not installed; it comes with a ROS 2 installation", field="source"
            ) from None
        if not rate_hz > 0.0:
            raise InvalidArgument(f"rate_hz must be above 0, got {rate_hz:g}", field="rate_hz")
        self._node, self._frames, self._take, self._problems = node, (scene_frame, probe_frame), take, problems
        self._failures = tf2_ros.TransformException
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)
        self._timer = node.create_timer(1.0 / rate_hz, self._look_up)
        self._last_ns: int | None = None  # stamp of what was passed on

    def close(self) -> None:
        """Look up no more."""
        self._node.destroy_timer(self._timer)
        self._listener.unregister()

    def _look_up(self) -> None:
        try:
            found = self._buffer.lookup_transform(*self._frames, Time())  # time 0: the newest
        except self._failures as error:
            self._problems.tell("NO_TRANSFORM", str(error))
            return
        stamp_ns = Time.from_msg(found.header.stamp).nanoseconds
        if stamp_ns != self._last_ns:
            self._last_ns = stamp_ns
            self._take(stamped_pose(found))
