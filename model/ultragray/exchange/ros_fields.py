"""Fields of ROS 2 messages that others wrote, checked before they are used, and poses among them.

A file brings its own definitions, and may call others by these names.
"""

from __future__ import annotations

import array
from typing import Any

import numpy as np

from ultragray.exchange.ros_messages import IMAGE, MM_PER_M, POSE, TEXT
from ultragray.geometry.pose import pose_from_position_quaternion
from ultragray.geometry.probe import FloatArray

COMPRESSED = "sensor_msgs/msg/CompressedImage"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"

_COUNT = range(1 << 32)  # uint32
_BYTES = (bytes, bytearray, memoryview, array.array)
_NUMBER = (int, float)

_STAMPED = {"header": {"stamp": {"sec": range(-1 << 31, 1 << 31), "nanosec": _COUNT}, "frame_id": str}}
_POINT = dict.fromkeys("xyz", _NUMBER)
_QUATERNION = dict.fromkeys("xyzw", _NUMBER)
_TRANSFORM = {**_STAMPED, "child_frame_id": str, "transform": {"translation": _POINT, "rotation": _QUATERNION}}

# By kind: types, ranges of whole numbers, fields of a message within, or a list of such messages.
_FIELDS: dict[str, dict[str, Any]] = {
    IMAGE: {
        **_STAMPED,
        **dict.fromkeys(("height", "width", "step"), _COUNT),
        "encoding": str,
        "is_bigendian": int,
        "data": _BYTES,
    },
    COMPRESSED: {**_STAMPED, "format": str, "data": _BYTES},
    POSE: {**_STAMPED, "pose": {"position": _POINT, "orientation": _QUATERNION}},
    TRANSFORM: _TRANSFORM,
    TRANSFORMS: {"transforms": [_TRANSFORM]},
    TEXT: {"data": str},
}


def check_fields(message: Any, kind: str) -> None:
    """Raises ValueError, naming the field, where a decoded message is not of the kind that it is called."""
    problem = _first_other(message, _FIELDS[kind])
    if problem is not None:
        raise ValueError(f"what it calls {kind} is another kind of message: see its field {problem}")


def _first_other(value: Any, wanted: Any) -> str | None:
    """Where a value is other than wanted: the path of a field, empty for the value itself."""
    if isinstance(wanted, dict):
        for name, kind in wanted.items():
            path = _first_other(getattr(value, name, None), kind)
            if path is not None:
                return f"{name}.{path}" if path else name
        return None
    if isinstance(wanted, list):
        if not isinstance(value, list):
            return ""
        return next((path for one in value if (path := _first_other(one, wanted[0])) is not None), None)
    is_as_wanted = type(value) is int and value in wanted if isinstance(wanted, range) else isinstance(value, wanted)
    return None if is_as_wanted else ""


def pose_of_message(message: Any, *, field: str) -> FloatArray:  # [4, 4] mm
    """The pose of a geometry_msgs/PoseStamped with attributes. Raises InvalidPose."""
    return pose_of_parts(message.pose.position, message.pose.orientation, field=field)


def pose_of_parts(position: Any, turn: Any, *, field: str) -> FloatArray:  # [4, 4] mm
    """The pose of a Point or Vector3 and a Quaternion with attributes. Raises InvalidPose."""
    x, y, z = MM_PER_M * np.array([position.x, position.y, position.z])
    return pose_from_position_quaternion((x, y, z), (turn.w, turn.x, turn.y, turn.z), field=field)
