"""Poses of the probe in messages of ROS 2, whose lengths are metres."""

from __future__ import annotations

from typing import Any

import numpy as np

from ultragray.interchange.ros_messages import MM_PER_M
from ultragray.pose import pose_from_position_quaternion
from ultragray.probe import FloatArray


def pose_of_message(message: Any, *, field: str) -> FloatArray:  # [4, 4] mm
    """The pose of a geometry_msgs/PoseStamped with attributes. Raises InvalidPose."""
    return pose_of_parts(message.pose.position, message.pose.orientation, field=field)


def pose_of_parts(position: Any, turn: Any, *, field: str) -> FloatArray:  # [4, 4] mm
    """The pose of a Point or Vector3 and a Quaternion with attributes. Raises InvalidPose."""
    x, y, z = MM_PER_M * np.array([position.x, position.y, position.z])
    return pose_from_position_quaternion((x, y, z), (turn.w, turn.x, turn.y, turn.z), field=field)
