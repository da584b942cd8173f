# Generated from ultragray.exchange.ros_messages by client/generate.py; change that.
"""Messages of ROS 2 as files hold them: their definitions, and what of ours becomes which. Needs no ROS.

ROS speaks metres: poses are converted here. A message is a dict of its fields. The Python client has a copy of this
module (client/generate.py), so it imports no more than that has, too.
"""

from __future__ import annotations

import colorsys
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
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
ANNOTATIONS = "foxglove_msgs/msg/ImageAnnotations"
LINE_LIST = 4  # of a PointsAnnotation: its points are ends of lines, two by two

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
    "foxglove_msgs/CircleAnnotation": (
        "builtin_interfaces/Time timestamp\nfoxglove_msgs/Point2 position\nfloat64 diameter\nfloat64 thickness\n"
        "foxglove_msgs/Color fill_color\nfoxglove_msgs/Color outline_color"
    ),
    "foxglove_msgs/PointsAnnotation": (
        "builtin_interfaces/Time timestamp\nuint8 type\nfoxglove_msgs/Point2[] points\n"
        "foxglove_msgs/Color outline_color\nfoxglove_msgs/Color[] outline_colors\nfoxglove_msgs/Color fill_color\n"
        "float64 thickness"
    ),
    "foxglove_msgs/TextAnnotation": (
        "builtin_interfaces/Time timestamp\nfoxglove_msgs/Point2 position\nstring text\nfloat64 font_size\n"
        "foxglove_msgs/Color text_color\nfoxglove_msgs/Color background_color"
    ),
    "foxglove_msgs/Point2": "float64 x\nfloat64 y",
    "foxglove_msgs/Color": "float64 r\nfloat64 g\nfloat64 b\nfloat64 a",
}
_HEADER = "std_msgs/Header header\n"
_OF_HEADERS = ("std_msgs/Header", "builtin_interfaces/Time")
_OF_POSES = ("geometry_msgs/Pose", "geometry_msgs/Point", "geometry_msgs/Quaternion")
_OF_DIAGNOSTICS = ("diagnostic_msgs/DiagnosticStatus", "diagnostic_msgs/KeyValue")


def _definition(fields: str, *parts: str) -> str:
    """The definition of a message, followed by those of all that it is made of."""
    whole = [fields, *(f"MSG: {name}\n{_PARTS[name]}" for name in parts)]
    return f"\n{_SEPARATOR}\n".join(whole) + "\n"


DEFINITIONS = {
    IMAGE: _definition(
        _HEADER + "uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data",
        *_OF_HEADERS,
    ),
    POSE: _definition(_HEADER + "geometry_msgs/Pose pose", *_OF_HEADERS, *_OF_POSES),
    DIAGNOSTICS: _definition(_HEADER + "diagnostic_msgs/DiagnosticStatus[] status", *_OF_HEADERS, *_OF_DIAGNOSTICS),
    TEXT: "string data\n",
    ANNOTATIONS: _definition(
        "foxglove_msgs/CircleAnnotation[] circles\nfoxglove_msgs/PointsAnnotation[] points\n"
        "foxglove_msgs/TextAnnotation[] texts",
        *(name for name in _PARTS if name.startswith("foxglove_msgs/")),
        "builtin_interfaces/Time",
    ),
}


def header(time_ns: int, frame_id: str) -> dict[str, Any]:
    return {"stamp": _stamp(time_ns), "frame_id": frame_id}


def _stamp(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // NS_PER_S, "nanosec": time_ns % NS_PER_S}


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


def annotations_message(labels: npt.NDArray[np.uint8], time_ns: int) -> dict[str, Any]:  # [H, W]
    """A foxglove_msgs/ImageAnnotations that outlines each label but 0, with its number at its topmost pixel.

    Coordinates are pixels from the top left corner of the image, so that the pixel (row, column) is the square from
    (column, row) to (column + 1, row + 1). The lines run along the edges between pixels inside and outside.
    """
    stamp = _stamp(time_ns)
    points, texts = [], []
    for label in (1 + np.flatnonzero(np.bincount(labels.ravel())[1:])).tolist():
        inside = labels == label
        colour = _colour(label)
        row, column = divmod(int(inside.argmax()), labels.shape[1])
        points.append(
            {
                "timestamp": stamp,
                "type": LINE_LIST,
                "points": [{"x": x, "y": y} for x, y in _outline(inside).tolist()],
                "outline_color": colour,
                "outline_colors": [],
                "fill_color": _NOTHING,
                "thickness": 1.0,
            }
        )
        texts.append(
            {
                "timestamp": stamp,
                "position": {"x": float(column), "y": float(row)},
                "text": str(label),
                "font_size": max(8.0, labels.shape[0] / 24),
                "text_color": colour,
                "background_color": _NOTHING,
            }
        )
    return {"circles": [], "points": points, "texts": texts}


_NOTHING = {"r": 0.0, "g": 0.0, "b": 0.0, "a": 0.0}
_GOLDEN_RATIO = 0.618033988749895  # its multiples spread the hues of any number of labels


def _colour(label: int) -> dict[str, float]:
    red, green, blue = colorsys.hsv_to_rgb(label * _GOLDEN_RATIO % 1.0, 0.8, 1.0)
    return {"r": red, "g": green, "b": blue, "a": 1.0}


def _outline(inside: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:  # [H, W] -> [N, 2]
    """Ends x, y of the lines around what is inside, two by two; edges in a row are one line."""
    padded = np.pad(inside, 1)
    lines = []
    for turned in (padded, padded.T):  # lines that lie, then lines that stand
        edges = np.pad((turned[1:, 1:-1] != turned[:-1, 1:-1]).astype(np.int8), ((0, 0), (1, 1)))
        steps = np.diff(edges, axis=1)
        rows, starts = np.nonzero(steps == 1)
        ends = np.nonzero(steps == -1)[1]
        lines.append(np.stack([starts, rows, ends, rows], axis=1).reshape(-1, 2))
    return np.concatenate([lines[0], lines[1][:, ::-1]]).astype(np.float64)
