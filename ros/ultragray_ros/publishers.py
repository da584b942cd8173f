"""What a frame becomes on the topics of the node, each with the stamp of its pose."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header, String

from ultragray_client import Frame
from ultragray_client.errors import UnknownOutput

from . import messages

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Publishers:
    """`~/OUTPUT` and `~/OUTPUT/compressed` of each output, `~/confidence`, and `~/geometry`, which is kept for whoever
    comes later.
    """

    def __init__(self, node: Node, probe_frame: str) -> None:
        self._node, self._probe_frame = node, probe_frame
        self._images: dict[str, tuple[Publisher, Publisher]] = {}
        self._confidence = node.create_publisher(DiagnosticArray, "~/confidence", qos_profile_sensor_data)
        self._geometry = node.create_publisher(String, "~/geometry", LATCHED)
        self._told_geometry: String | None = None

    def offer(self, outputs: tuple[str, ...]) -> None:
        """Have topics for these outputs, beside those of before. Raises UnknownOutput for one that cannot be a name."""
        for output in outputs:
            if output in self._images:
                continue
            try:
                self._images[output] = (
                    self._node.create_publisher(Image, f"~/{output}", qos_profile_sensor_data),
                    self._node.create_publisher(CompressedImage, f"~/{output}/compressed", qos_profile_sensor_data),
                )
            except InvalidTopicNameException:
                raise UnknownOutput(f"outputs must be words such as bmode, got {output!r}", field="outputs") from None

    def publish(self, frame: Frame, pose_header: Header, *, least_confidence: float | None, replaced: int) -> None:
        """Publish a frame; pixels only where somebody subscribes to them."""
        header = Header(stamp=pose_header.stamp, frame_id=self._probe_frame)
        geometry = messages.geometry(frame, self._probe_frame)
        if geometry != self._told_geometry:
            self._told_geometry = geometry
            self._geometry.publish(geometry)
        self._confidence.publish(messages.confidence(frame, header, least=least_confidence, replaced=replaced))
        for output, pixels in frame.arrays.items():
            plain, compressed = self._images[output]
            if plain.get_subscription_count():
                plain.publish(messages.image(pixels, header))
            if compressed.get_subscription_count():
                compressed.publish(messages.compressed_image(pixels, header))

    def close(self) -> None:
        """Take back the topics."""
        for publisher in (self._confidence, self._geometry, *(one for pair in self._images.values() for one in pair)):
            self._node.destroy_publisher(publisher)
