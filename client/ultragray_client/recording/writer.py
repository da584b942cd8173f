# Generated from ultragray.exchange.ros_recording by client/generate.py; change that.
"""Frames as messages of ROS 2 in an MCAP file, on the topics of the ROS 2 node, with their definitions.

The extra `mcap`. The Python client has a copy of this module (client/generate.py): the same frames are the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import IO, Any

import numpy.typing as npt
from mcap_ros2.writer import Writer

from ultragray_client.geometry import FloatArray
from ultragray_client.recording import messages as ros

TOPICS = "/ultragray"
LABELS = "labels"  # the output that is outlined
METADATA = "ultragray"  # the record of the origin: its objects as JSON


class RosRecording:
    """A writer of /ultragray/OUTPUT, /ultragray/probe_pose, /ultragray/confidence and /ultragray/geometry, and, of
    frames with the output labels, of their outlines for Foxglove on /ultragray/annotations.

    The origin of the frames is a metadata record, and their geometry a message: of the first frame, and again where
    they change. Only `finish` makes the file whole; without it a reader that needs no index has all but the last chunk.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._writer = Writer(file)
        self._schemas = {name: self._writer.register_msgdef(name, text) for name, text in ros.DEFINITIONS.items()}
        self._count = 0
        self._origin: Mapping[str, Any] | None = None
        self._geometry: dict[str, Any] | None = None

    def add(
        self,
        images: Mapping[str, npt.NDArray[Any]],  # by output, each [H, W] uint8 or little-endian float32
        pose: FloatArray,  # [4, 4] mm
        figures: Mapping[str, float | None],
        origin: Mapping[str, Any],
        time_ns: int,
    ) -> None:
        """Write the next frame with the stamp of its pose; `figures` of None are left out. Raises OSError."""
        if origin != self._origin:
            self._origin = origin
            self._tell_origin(origin, time_ns)
        self._write("probe_pose", ros.POSE, ros.pose_message(pose, time_ns), time_ns)
        message = ros.figures_message(figures, time_ns, name=origin["scene"], hardware_id=origin["scene_sha256"])
        self._write("confidence", ros.DIAGNOSTICS, message, time_ns)
        for output, pixels in images.items():
            self._write(output, ros.IMAGE, ros.image_message(pixels, time_ns), time_ns)
        if LABELS in images:
            self._write("annotations", ros.ANNOTATIONS, ros.annotations_message(images[LABELS], time_ns), time_ns)
        self._count += 1

    def finish(self) -> None:
        """Write the index, after the last frame. Raises OSError."""
        self._writer.finish()

    def _tell_origin(self, origin: Mapping[str, Any], time_ns: int) -> None:
        record = {key: one if isinstance(one, str) else json.dumps(one, sort_keys=True) for key, one in origin.items()}
        self._writer.add_metadata(METADATA, record)
        geometry = ros.geometry_message(origin)
        if geometry != self._geometry:
            self._geometry = geometry
            self._write("geometry", ros.TEXT, geometry, time_ns)

    def _write(self, topic: str, kind: str, message: Mapping[str, object], time_ns: int) -> None:
        self._writer.write_message(
            f"{TOPICS}/{topic}",
            self._schemas[kind],
            message,
            log_time=time_ns,
            publish_time=time_ns,
            sequence=self._count,
        )
