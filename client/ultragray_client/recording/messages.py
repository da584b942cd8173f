# Generated from ultragray.exchange.ros_messages by client/generate.py; change that.
"""Standard messages of ROS 2 as files hold them: their definitions, and what of ours becomes which. Needs no ROS.

ROS speaks metres: poses are converted here. A message is a dict of its fields. The Python client has a copy of this
module (client/generate.py), so it imports no more than that has, too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy.typing as npt

from ultragray_client.geometry import FloatArray
from ultragray_client.poses import quaternion_from_pose

MM_PER_M = 1000.0
NS_PER_S = 1_000_000_000
SCENE_FRAME, PROBE_FRAME = "scene", "probe"
ENCODINGS = {"u1": "mono8", "f4": "32FC1"}  # of sensor_msgs/Image, by pixel type
OK, WARN = 0, 1  # levels of DiagnosticStatus

IMAGE = "sensor_msgs/msg/Image"
POSE = "geometry_msgs/msg/PoseStamped"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
TEXT = "std_msgs/msg/String"

_SEPARATOR = "=" * 80
_PARTS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte level\nstring name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values"
    ),
    "diagnostic_msgs/KeyValue": "string key\nstring value",
}
_OF_EVERY = ("std_msgs/Header", "builtin_interfaces/Time")
_OF_POSES = ("geometry_msgs/Pose", "geometry_msgs/Point", "geometry_msgs/Quaternion")
_OF_DIAGNOSTICS = ("diagnostic_msgs/DiagnosticStatus", "diagnostic_msgs/KeyValue")


def _definition(fields: str, *parts: str) -> str:
    """The definition of a message with a header, followed by those of all that it is made of."""
    whole = [f"std_msgs/Header header\n{fields}"]
    whole += [f"MSG: {name}\n{_PARTS[name]}" for name in (*_OF_EVERY, *parts)]
    return f"\n{_SEPARATOR}\n".join(whole) + "\n"


DEFINITIONS = {
    IMAGE: _definition(
        "uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data",
    ),
    POSE: _definition("geometry_msgs/Pose pose", *_OF_POSES),
    DIAGNOSTICS: _definition("diagnostic_msgs/DiagnosticStatus[] status", *_OF_DIAGNOSTICS),
    TEXT: "string data\n",
}


def header(time_ns: int, frame_id: str) -> dict[str, Any]:
    return {"stamp": {"sec": time_ns // NS_PER_S, "nanosec": time_ns % NS_PER_S}, "frame_id": frame_id}


def image_message(pixels: npt.NDArray[Any], time_ns: int) -> dict[str, Any]:  # [H, W] uint8 or little-endian float32
    """A sensor_msgs/Image in the frame of the probe."""
    height, width = pixels.shape
    return {
        "header": header(time_ns, PROBE_FRAME),
        "height": height,
        "width": width,
        "encoding": ENCODINGS[pixels.dtype.str[1:]],
        "is_bigendian": 0,
        "step": width * pixels.itemsize,
        "data": pixels.tobytes(),
    }


def pose_message(pose: FloatArray, time_ns: int) -> dict[str, Any]:  # [4, 4] mm
    """A geometry_msgs/PoseStamped of the probe in the frame of the scene."""
    x, y, z = (float(value) / MM_PER_M for value in pose[:3, 3])
    w, i, j, k = quaternion_from_pose(pose)
    turn = {"x": i, "y": j, "z": k, "w": w}
    return {
        "header": header(time_ns, SCENE_FRAME),
        "pose": {"position": {"x": x, "y": y, "z": z}, "orientation": turn},
    }


def figures_message(
    figures: Mapping[str, float | None], time_ns: int, *, name: str, hardware_id: str
) -> dict[str, Any]:
    """A diagnostic_msgs/DiagnosticArray with the figures that are known; WARN where the confidence is not."""
    known = {key: value for key, value in figures.items() if value is not None}
    is_known = "confidence" in known
    status = {
        "level": OK if is_known else WARN,
        "name": f"ultragray: {name}",
        "message": f"confidence {known['confidence']:.2f}" if is_known else "the scene cannot tell its confidence",
        "hardware_id": hardware_id,
        "values": [{"key": key, "value": f"{value:g}"} for key, value in known.items()],
    }
    return {"header": header(time_ns, PROBE_FRAME), "status": [status]}


def geometry_document(origin: Mapping[str, Any], frame_id: str) -> dict[str, Any]:
    """Where the pixels lie in the frame of the probe, and all of what was rendered, from the origin of frames.

    `pixel_to_probe_m` [4, 4] takes (column, row, k, 1) to metres, k metres against the elevation y; None where columns
    are scan lines of a fan. `picture` describes the pixels in either case, in mm and degrees.
    """
    picture = origin["picture"]
    (column, row), (column_step, row_step) = picture["first"], picture["step"]
    matrix = None
    if picture["column_unit"] == "mm":
        across, down = [column_step / MM_PER_M, 0.0, 0.0, column / MM_PER_M], [0.0, row_step / MM_PER_M, 0.0]
        matrix = [across, [0.0, 0.0, -1.0, 0.0], [*down, row / MM_PER_M], [0.0, 0.0, 0.0, 1.0]]
    return {
        **origin,
        "frame_id": frame_id,
        "height": picture["height"],
        "width": picture["width"],
        "pixel_to_probe_m": matrix,
        "picture": {
            "column_unit": picture["column_unit"],
            "first_column": column,
            "first_row_mm": row,
            "column_step": column_step,
            "row_step_mm": row_step,
        },
    }


def geometry_message(origin: Mapping[str, Any]) -> dict[str, Any]:
    """A std_msgs/String with the geometry of frames as JSON."""
    return {"data": json.dumps(geometry_document(origin, PROBE_FRAME), sort_keys=True)}
