"""MCAP: messages of ROS 2 on the topics of the ROS 2 node. The extra `mcap`."""

from __future__ import annotations

from collections.abc import Mapping

from ultragray.exchange.exports.exporter import FRAME_TIME_MS, Exporter
from ultragray.exchange.ros_recording import RosRecording
from ultragray.rendering.pixels import PixelArray


class McapExporter(Exporter):
    """A writer of the topics of `RosRecording`, 25 frames a second from time 0."""

    def _open(self) -> None:
        self._recording = RosRecording(self._stack.enter_context(self._path.open("wb")))
        self._origin = self._header.origin()

    def _write(self, frames: Mapping[str, PixelArray], count: int) -> None:
        for place in range(count):
            number = self._done + place
            self._recording.add(
                {output: frames[output][place] for output in self._header.settings.outputs},
                self._header.poses[number],
                self._extrapolations[number].figures(),
                self._origin,
                round(number * FRAME_TIME_MS * 1e6),
            )

    def _finish(self) -> None:
        self._recording.finish()
