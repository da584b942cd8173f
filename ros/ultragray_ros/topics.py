"""The node's ties to ROS: topics of frames, and poses from the transforms by tf2_ros, of which there is no wheel."""

from __future__ import annotations

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header, String

from ultragray_client import Frame, ViewPlan
from ultragray_client.errors import InvalidArgument, UnknownOutput
from ultragray_ros import messages
from ultragray_ros.messages import stamped_pose
from ultragray_ros.newest import Problems

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Publishers:
    """`~/OUTPUT` and `~/OUTPUT/compressed` of each output, `~/confidence`, and what is kept for whoever comes later:
    `~/geometry`, `~/plan` and `~/plan/report`.
    """

    def __init__(self, node: Node, probe_frame: str) -> None:
        self._node, self._probe_frame = node, probe_frame
        self._images: dict[str, tuple[Publisher, Publisher]] = {}
        self._confidence = node.create_publisher(DiagnosticArray, "~/confidence", qos_profile_sensor_data)
        self._geometry = node.create_publisher(String, "~/geometry", LATCHED)
        self._plan = node.create_publisher(PoseArray, "~/plan", LATCHED)
        self._plan_report = node.create_publisher(String, "~/plan/report", LATCHED)
        self._last_geometry: String | None = None

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
        if geometry != self._last_geometry:
            self._last_geometry = geometry
            self._geometry.publish(geometry)
        self._confidence.publish(messages.confidence(frame, header, least=least_confidence, replaced=replaced))
        for output, pixels in frame.arrays.items():
            plain, compressed = self._images[output]
            if plain.get_subscription_count():
                plain.publish(messages.image(pixels, header))
            if compressed.get_subscription_count():
                compressed.publish(messages.compressed_image(pixels, header))

    def publish_plan(self, plan: ViewPlan, header: Header) -> None:
        self._plan_report.publish(messages.plan_report(plan))
        self._plan.publish(messages.planned_poses(plan, header))

    def close(self) -> None:
        """Take back the topics."""
        images = (one for pair in self._images.values() for one in pair)
        for publisher in (self._confidence, self._geometry, self._plan, self._plan_report, *images):
            self._node.destroy_publisher(publisher)


# Poses of the probe from the transforms of ROS, by tf2_ros of a ROS 2 installation: there is no wheel of it.


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
