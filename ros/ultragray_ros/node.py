"""The node: a lifecycle node whose parameters are the settings of its frames.

    ultragray-ros --ros-args -p scene:=liver -p display.gain_db:=6.0

Configuring makes the topics, activating takes poses. A pose that is refused, a service that is away, a frame that comes
too late or a scene that does not exist is logged; nothing is published for it, and the node goes on.
"""

from __future__ import annotations

import os
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from ultragray_client import Client, Frame, RenderSettings, Tls
from ultragray_client.errors import (
    ClientError,
    InvalidArgument,
    InvalidPose,
    LowConfidence,
    NotFound,
    PermissionDenied,
    Unauthenticated,
    Unimplemented,
)
from ultragray_ros.newest import Problems
from ultragray_ros.real import RealFrames
from ultragray_ros.topics import Publishers, TransformedPoses

from . import messages, parameters
from .newest import NewestFrames

API_KEY = "ULTRAGRAY_API_KEY"  # parameters are read by everybody on the network, the environment is not
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # fits publishers of either reliability
# Nobody asks again, and best effort loses what comes before the node knows its publisher.
ASKED_ONCE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
CHECK_TIMEOUT_S = 2.0
LOOK_EVERY_S = 1.0  # whether the node was told to stop: what rclpy wakes it by on a signal is lost now and then
OWN_PARAMETERS: dict[str, tuple[Any, str]] = {
    "address": ("localhost:50051", "HOST:PORT of the service's gRPC"),
    "tls": (False, "whether the connection is encrypted"),
    "root_certificates": ("", "PEM file of the authority to trust; empty: those of the system"),
    "source": ("pose", "where poses come from: pose (the topic ~/probe_pose) or tf"),
    "rate_hz": (60.0, "of the look-ups, with source tf"),
    "scene_frame": ("scene", "frame of the scene, in which poses are given"),
    "probe_frame": ("probe", "frame of the probe, in which images lie"),
    "seen_after_ms": (
        -1.0,
        "frames are those of where the probe will be so long after they come, foretold by the stamps of poses; "
        "-1: of the poses as they come",
    ),
    "recording": ("", "dataset that images of ~/real_image are recorded into, at the poses; empty: none are taken"),
    "timeout_s": (1.0, "frames that are further behind their pose are not published"),
    "autostart": (True, "whether the node configures and activates itself"),
}
SCENE = ("demo", "name of the scene")
_ABOUT_SETTINGS = (InvalidArgument, NotFound, PermissionDenied, Unauthenticated, Unimplemented)
_ABOUT_THE_POSE = (InvalidPose, LowConfidence)


class UltrasoundNode(LifecycleNode):  # type: ignore[misc]
    """Poses of a probe in, images of an UltraG-Ray service out."""

    def __init__(self) -> None:
        super().__init__("ultragray")
        for name, (default, meaning) in OWN_PARAMETERS.items():
            self.declare_parameter(name, default, ParameterDescriptor(description=meaning, read_only=True))
        self.declare_parameter("scene", SCENE[0], ParameterDescriptor(description=SCENE[1]))
        for name, default in parameters.plan_defaults().items():
            meaning = f"{name.removeprefix(parameters.PLAN)} of the plan settings; -1 or empty: their default"
            self.declare_parameter(name, default, ParameterDescriptor(description=meaning))
        for name, default in parameters.defaults().items():
            meaning = f"{name} of the render settings; -1 or empty, where that is the default: as the scene has it"
            self.declare_parameter(name, default, ParameterDescriptor(description=meaning))
        self._problems = Problems(self.get_logger().warning)
        self._client: Client | None = None
        self._topics: Publishers | None = None
        self._frames: NewestFrames[Header] | None = None
        self._poses: TransformedPoses | None = None
        self._subscription: Any = None
        self._plan_subscription: Any = None
        self._real: RealFrames | None = None
        self._image_subscription: Any = None
        self._planner = ThreadPoolExecutor(1, "plan")  # a plan takes a second, in which frames go on
        self._planning: Future[None] = Future()  # the newest
        self._last_pose: PoseStamped | None = None
        self._settings = RenderSettings()
        self.add_on_set_parameters_callback(self._check_parameters)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make the connection, which asks for nothing yet, and the topics."""
        try:
            self._settings = parameters.settings_of(self._values())
            self._client = self._connected()
            self._topics = Publishers(self, self._value("probe_frame"))
            self._topics.offer(self._settings.outputs)
        except ClientError as error:
            self.get_logger().error(str(error))
            self.close()
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take poses."""
        assert self._client is not None
        self._frames = NewestFrames(
            self._client,
            self._value("scene"),
            self._settings,
            timeout_s=self._value("timeout_s"),
            seen_after_ms=self._value("seen_after_ms") if self._value("seen_after_ms") >= 0.0 else None,
            take=self._publish,
            tell=lambda error: self._problems.tell(error.reason, error.detail),
        )
        try:
            self._record()
            self._take_poses()
            self._plan_subscription = self.create_subscription(PoseStamped, "~/plan_from", self._plan, ASKED_ONCE)
        except ClientError as error:
            self.get_logger().error(str(error))
            self._stop()
            return TransitionCallbackReturn.FAILURE
        source, scene_frame, scene, address = map(self._value, ("source", "scene_frame", "scene", "address"))
        self.get_logger().info(
            f"takes poses from {source} in the frame {scene_frame!r}, and publishes frames of the scene {scene!r} by "
            f"{address} below {self.get_fully_qualified_name()}"
        )
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take no more poses."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give up connection and topics."""
        self.close()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give up everything."""
        self.close()
        return super().on_shutdown(state)

    def close(self) -> None:
        """End the rendering, and give up connection and topics."""
        self._stop()
        if self._topics is not None:
            self._topics.close()
        if self._client is not None:
            self._client.close()
        self._topics = self._client = None

    def _stop(self) -> None:
        if self._poses is not None:
            self._poses.close()
        for subscription in (self._subscription, self._plan_subscription, self._image_subscription):
            if subscription is not None:
                self.destroy_subscription(subscription)
        if self._frames is not None:
            self._frames.close()
        if self._real is not None:
            self._real.close()
        self._poses = self._subscription = self._plan_subscription = self._image_subscription = None
        self._frames = self._real = None

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _values(self) -> dict[str, Any]:
        return {name: self._value(name) for name in parameters.defaults()}

    def _connected(self) -> Client:
        tls = Tls(root_certificates=self._value("root_certificates") or None) if self._value("tls") else None
        return Client(self._value("address"), api_key=os.environ.get(API_KEY) or None, tls=tls)

    def _take_poses(self) -> None:
        """Begin to take poses. Raises InvalidArgument for a source that does not exist, or not here."""
        match self._value("source"):
            case "pose":
                self._subscription = self.create_subscription(PoseStamped, "~/probe_pose", self._take, NEWEST)
            case "tf":
                self._poses = TransformedPoses(
                    self,
                    self._value("scene_frame"),
                    self._value("probe_frame"),
                    rate_hz=self._value("rate_hz"),
                    take=self._take,
                    problems=self._problems,
                )
            case other:
                raise InvalidArgument(f"source must be pose or tf, got {other!r}", field="source")

    def _record(self) -> None:
        """Begin to take real images, where they are to be recorded. Raises InvalidArgument."""
        if not (name := self._value("recording")):
            return
        probe, registration = self._settings.probe, self._settings.registration
        if probe is None or registration is not None or self._client is None:
            raise InvalidArgument(
                "recording takes the probe of the images (probe), and poses of this probe (no registration)",
                field="recording",
            )
        self._real = RealFrames(
            self._client, name, probe, tell=lambda error: self._problems.tell(error.reason, error.detail)
        )
        self._image_subscription = self.create_subscription(
            Image, "~/real_image", self._take_image, qos_profile_sensor_data
        )

    def _take_image(self, image: Image) -> None:
        try:
            pixels = messages.real_pixels(image)
        except InvalidArgument as error:
            self._problems.tell(error.reason, error.detail)
            return
        if self._real is not None:
            self._real.image(Time.from_msg(image.header.stamp).nanoseconds, pixels)

    def _take(self, pose: PoseStamped) -> None:
        """A pose came. One that names another frame than the scene's would be taken for what it is not."""
        if not self._is_in_scene(pose):
            return
        self._last_pose = pose
        if self._real is not None:
            self._real.pose(Time.from_msg(pose.header.stamp).nanoseconds, messages.placement(pose))
        if self._frames is not None:
            age_ns = (self.get_clock().now() - Time.from_msg(pose.header.stamp)).nanoseconds
            self._frames.render(messages.placement(pose), pose.header, age_ns / 1e9)

    def _is_in_scene(self, pose: PoseStamped) -> bool:
        scene_frame = self._value("scene_frame")
        if pose.header.frame_id in ("", scene_frame):
            return True
        self._problems.tell(
            "FRAME_REFUSED",
            f"poses must be given in the frame {scene_frame!r}, got one in {pose.header.frame_id!r}: transform it, "
            "or run the node with source tf",
        )
        return False

    def _plan(self, start: PoseStamped) -> None:
        """Where to look next was asked for, from where the probe is."""
        if self._is_in_scene(start):
            self._planning.cancel()  # one that has not begun: the newest question counts
            self._planning = self._planner.submit(self._publish_plan, start)

    def _publish_plan(self, start: PoseStamped) -> None:
        values = {name: self._value(name) for name in parameters.plan_defaults()}
        client, topics, frames = self._client, self._topics, self._settings
        try:
            asked = replace(parameters.plan_settings_of(values), probe=frames.probe)
            if client is None or topics is None:
                return
            plan = client.plan_views(
                self._value("scene"), asked, start=messages.placement(start), registration=frames.registration
            )
        except ClientError as error:
            self._problems.tell(error.reason, f"no plan: {error.detail}")
            return
        if self.context.ok() and topics is self._topics:
            topics.publish_plan(plan, Header(stamp=start.header.stamp, frame_id=self._value("scene_frame")))

    def _publish(self, frame: Frame, header: Header, replaced: int) -> None:
        if self._topics is None or not self.context.ok():  # told to stop while a frame was under way
            return
        self._topics.publish(frame, header, least_confidence=self._settings.min_confidence, replaced=replaced)

    def _check_parameters(self, changed: list[Parameter]) -> SetParametersResult:
        """Take over other settings, unless the service refuses them."""
        values = {"scene": self._value("scene"), **self._values()}
        given = {parameter.name: parameter.value for parameter in changed if parameter.name in values}
        if self._client is None or not given:  # what is set before the node is configured is used then
            return SetParametersResult(successful=True)
        values |= given
        try:
            settings = parameters.settings_of(values)
            self._ask_service(self._client, values["scene"], settings)
            assert self._topics is not None
            self._topics.offer(settings.outputs)
        except ClientError as error:
            return SetParametersResult(successful=False, reason=error.detail)
        self._settings = settings
        if self._frames is not None:
            self._frames.change(values["scene"], settings)
        return SetParametersResult(successful=True)

    def _ask_service(self, client: Client, scene: str, settings: RenderSettings) -> None:
        """Render one frame with other settings. Raises ClientError where it is refused for their sake."""
        pose = messages.placement(self._last_pose or PoseStamped())
        try:
            client.render(scene, pose, settings, timeout_s=CHECK_TIMEOUT_S)
        except _ABOUT_THE_POSE:
            return
        except _ABOUT_SETTINGS:
            raise
        except ClientError as error:
            self._problems.tell(error.reason, f"settings were taken over unchecked: {error.detail}")


def main() -> None:
    """Run the node until it is told to stop: the command `ultragray-ros`."""
    rclpy.init()
    node = UltrasoundNode()
    try:
        if node.get_parameter("autostart").value and not _started(node):
            sys.exit(1)
        executor = rclpy.get_global_executor()
        executor.add_node(node)
        while executor.context.ok():
            executor.spin_once(timeout_sec=LOOK_EVERY_S)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()


def _started(node: UltrasoundNode) -> bool:
    """Configure and activate; the log says why it failed."""
    done = TransitionCallbackReturn.SUCCESS
    return all(transition() == done for transition in (node.trigger_configure, node.trigger_activate))


if __name__ == "__main__":
    main()
