"""MCAP: messages of ROS 2 on the topics of the ROS 2 node, with their definitions. The extra `mcap`."""

from __future__ import annotations

import json
from collections.abc import Mapping

from mcap_ros2.writer import Writer

from ...display.pixels import PixelArray
from .. import ros_messages as ros
from .exporter import FRAME_TIME_MS, Exporter

TOPICS = "/ultragray"
METADATA = "ultragray"  # the record of the origin: its objects as JSON


class McapExporter(Exporter):
    """A writer of /ultragray/OUTPUT, /ultragray/probe_pose and /ultragray/confidence, 25 a second from time 0."""

    def _open(self) -> None:
        file = self._held.enter_context(self._path.open("wb"))
        self._writer = writer = Writer(file)
        self._schemas = {name: writer.register_msgdef(name, text) for name, text in ros.DEFINITIONS.items()}
        origin = self._header.origin()
        writer.add_metadata(
            METADATA, {key: one if isinstance(one, str) else json.dumps(one) for key, one in origin.items()}
        )

    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        header = self._header
        for place in range(count):
            number = self._done + place
            time_ns = round(number * FRAME_TIME_MS * 1e6)
            figures = self._extrapolations[number].figures()
            self._add("probe_pose", ros.POSE, ros.pose_message(header.poses[number], time_ns), number, time_ns)
            told = ros.figures_message(figures, time_ns, name=header.scene, hardware_id=header.scene_sha256)
            self._add("confidence", ros.DIAGNOSTICS, told, number, time_ns)
            for output in header.settings.outputs:
                image = ros.image_message(frames[output][place], time_ns)
                self._add(output, ros.IMAGE, image, number, time_ns)

    def _add(self, topic: str, kind: str, message: Mapping[str, object], number: int, time_ns: int) -> None:
        self._writer.write_message(
            f"{TOPICS}/{topic}", self._schemas[kind], message, log_time=time_ns, publish_time=time_ns, sequence=number
        )

    def _finish(self) -> None:
        self._writer.finish()


EXPORTER = McapExporter
