"""The node between a real service and a real publisher; poses from transforms, by a stand-in of tf2."""

import io
import json
import re
import sys
import types
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image as Picture

from ultragray.learn.motion import add_motion
from ultragray.scene.motion_settings import MotionSettings
from ultragray_client import Client, Display, PlanSettings, RenderSettings
from ultragray_workers.datasets.store import open_datasets

from ..surroundings import ROOT
from ..waiting import wait_until

pytestmark = pytest.mark.slow

CONFIGURE, CLEANUP, ACTIVATE, DEACTIVATE = 1, 2, 3, 4


def pixels(image):
    return np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)


def rendered(service, y_mm, settings=None):
    pose = np.eye(4)
    pose[1, 3] = y_mm
    with Client(service.grpc) as client:
        return client.render("demo", pose, settings)["bmode"]


def test_a_pose_becomes_an_image_with_its_stamp_its_confidence_and_its_geometry(start_node, peer, ros_service):
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import CompressedImage, Image
    from std_msgs.msg import String

    node = start_node(address=ros_service.grpc)
    images = peer.listen(Image, "bmode")
    told = peer.listen(DiagnosticArray, "confidence")
    files = peer.listen(CompressedImage, "bmode/compressed")
    image = peer.frame(images, 100, y_m=0.002)
    assert (image.header.frame_id, image.encoding, image.step) == ("probe", "mono8", image.width)
    expected = rendered(ros_service, 2.0)
    np.testing.assert_array_equal(pixels(image), expected)

    file = peer.frame(files, 101, y_m=0.002)
    decoded = np.asarray(Picture.open(io.BytesIO(bytes(file.data))), np.float64)
    assert np.abs(decoded - expected).mean() < 3.0
    assert file.format.startswith("mono8; jpeg")

    status = peer.frame(told, 102, y_m=0.002).status[0]
    values = {one.key: float(one.value) for one in status.values}
    with Client(ros_service.grpc) as client:
        frame = client.render("demo", np.eye(4))
    assert values["supported_share"] > 0.0
    assert values["latency_ms"] > 0.0
    assert status.hardware_id == frame.scene_sha256

    late = peer.listen(String, "geometry", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    geometry = json.loads(wait_until(lambda: late and late[-1].data))
    matrix_mm = frame.picture.pixel_to_probe()
    column_row = np.array([3.0, 5.0, 0.0, 1.0])
    metres = np.array(geometry["pixel_to_probe_m"]) @ column_row
    np.testing.assert_allclose(metres[:3] * 1000.0, (matrix_mm @ column_row)[:3])
    assert (geometry["height"], geometry["width"]) == expected.shape
    assert "takes poses from pose in the frame 'scene', and publishes frames of the scene 'demo' by " in node.log()
    assert node.stop() == 0


def test_a_plan_is_published_for_whoever_asks_where_to_look_next(start_node, peer, ros_service):
    from geometry_msgs.msg import PoseArray, PoseStamped
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
    from std_msgs.msg import String

    start_node(**{"address": ros_service.grpc, "plan.views": 3, "plan.within_mm": 0.5, "plan.tilt_deg": 20.0})
    kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    plans, reports = peer.listen(PoseArray, "plan", kept), peer.listen(String, "plan/report", kept)
    asking = peer.node.create_publisher(PoseStamped, "/ultragray/plan_from", 10)
    start = PoseStamped()
    start.header.frame_id, start.header.stamp.sec, start.pose.orientation.w = "scene", 7, 1.0
    wait_until(asking.get_subscription_count)
    listening = peer.node.get_subscriptions_info_by_topic("/ultragray/plan_from")
    assert {one.qos_profile.reliability for one in listening} == {ReliabilityPolicy.RELIABLE}, "a question may be lost"
    asking.publish(start)
    plan = wait_until(lambda: plans and plans[-1])
    with Client(ros_service.grpc) as client:
        asked = PlanSettings(views=3, within_mm=0.5, tilt_deg=20.0)
        wanted = client.plan_views("demo", asked, start=np.eye(4))
    assert (plan.header.frame_id, plan.header.stamp.sec) == ("scene", 7)
    places = [(one.position.x, one.position.y, one.position.z) for one in plan.poses]
    np.testing.assert_allclose(1000.0 * np.array(places), [one.pose[:3, 3] for one in wanted.views], atol=1e-6)
    report = json.loads(wait_until(lambda: reports and reports[-1].data))
    np.testing.assert_allclose(report["gains"], [one.gain for one in wanted.views])


def test_real_images_are_recorded_at_the_poses_of_their_stamps(start_node, peer, start_service, tmp_path):
    from sensor_msgs.msg import Image

    from ultragray_ros.messages import image
    from ultragray_ros.topics import Header

    service = start_service(artifact_folder=tmp_path)
    start_node(address=service.grpc, recording="liver", probe="L12-4")
    images = peer.node.create_publisher(Image, "/ultragray/real_image", 10)
    wait_until(images.get_subscription_count)
    seen = np.random.default_rng(0).integers(0, 255, (12, 16), dtype=np.uint8)

    def recorded():
        recordings = open_datasets(tmp_path, tmp_path).recordings
        if not recordings.is_open("liver"):
            return None
        return next((one for block in recordings.frames("liver") for one in block), None)

    stamps = iter(range(1, 1000))

    def again():
        """An image between two poses, and what has come of it."""
        stamp = next(stamps)
        header = Header()
        header.stamp.sec, header.stamp.nanosec = stamp, 100_000_000
        images.publish(image(seen, header))
        peer.pose(stamp, y_m=0.002)
        peer.pose(stamp, nanosec=200_000_000, y_m=0.004)
        return recorded()

    frame = wait_until(again, every_s=0.1)
    np.testing.assert_array_equal(frame.pixels, seen)
    np.testing.assert_allclose(frame.pose[:3, 3], (0.0, 3.0, 0.0), atol=1e-9)


def test_the_command_of_the_launch_file_starts_the_node(start_node, peer, ros_service):
    from sensor_msgs.msg import Image

    launch = ElementTree.parse(ROOT / "ros/launch/ultragray.launch.xml").getroot()
    values = {one.attrib["name"]: one.attrib["default"] for one in launch.iter("arg")}
    values |= {"address": ros_service.grpc, "probe_frame": "transducer"}
    (executable,) = launch.iter("executable")
    assert set(re.findall(r"\$\(var (\w+)\)", ElementTree.tostring(launch, "unicode"))) == set(values)
    program, flag, *words = re.sub(r"\$\(var (\w+)\)", lambda found: values[found[1]], executable.attrib["cmd"]).split()
    assert (program, flag) == ("ultragray-ros", "--ros-args")
    start_node(**dict(word.split(":=") for word in words[1::2]))
    assert peer.frame(peer.listen(Image, "bmode"), 1).header.frame_id == "transducer"


def test_settings_are_parameters_which_the_service_checks(start_node, peer, ros_service):
    from sensor_msgs.msg import Image

    start_node(address=ros_service.grpc, width="40")
    images = peer.listen(Image, "bmode")
    assert peer.frame(images, 1).width == 40
    assert peer.set("display.gain_db", 12.0) is None
    brighter = RenderSettings(width=40, display=Display(gain_db=12.0))
    np.testing.assert_array_equal(pixels(peer.frame(images, 2)), rendered(ros_service, 0.0, brighter))
    refused = peer.set("display.gain_db", 5000.0)
    assert refused is not None
    assert "display.gain_db must be a finite number from -100 to 100" in refused
    assert "absent" in (peer.set("scene", "absent") or "")
    assert "below_min_confidence must be one of refuse, mask" in (peer.set("below_min_confidence", "hide") or "")
    assert "kind" in (peer.set("probe", "{}") or "")
    assert peer.set("probe", '{"kind": "convex", "opening_angle_deg": 60, "near_mm": 10, "far_mm": 50}') is None
    assert peer.set("display.pixel_mm", 0.5) is None
    assert peer.set("address", "elsewhere:1") is not None
    image = peer.frame(images, 3)
    assert image.width > 40, "a fan, scan-converted"
    assert peer.set("outputs", ["bmode", "transmittance"]) is None
    assert peer.frame(peer.listen(Image, "transmittance"), 4).width == image.width


def test_tissue_moves_by_parameters(start_node, peer, start_service, tmp_path, demo_scene):
    from sensor_msgs.msg import Image

    add_motion(demo_scene, MotionSettings(chest_mm=6.0)).scene.save(tmp_path / "demo.ugr")
    service = start_service(data_folder=tmp_path)
    start_node(address=service.grpc, phase="[1.0]")
    images = peer.listen(Image, "bmode")
    inhaled, at_rest = rendered(service, 0.0, RenderSettings(phase=(1.0,))), rendered(service, 0.0)
    assert not np.array_equal(inhaled, at_rest)
    np.testing.assert_array_equal(pixels(peer.frame(images, 1)), inhaled)
    assert "one number for each mode (breathing), got 2" in (peer.set("phase", [0.0, 1.0]) or "")
    assert "one chooses the other" in (peer.set("breathing", '{"period_s": 3}') or "")
    assert peer.set("phase", [np.nan]) is None
    np.testing.assert_array_equal(pixels(peer.frame(images, 2)), at_rest)
    assert "breathing must be JSON with period_s, depth" in (peer.set("breathing", "deeply") or "")
    assert peer.set("breathing", '{"period_s": 3}') is None
    first = pixels(peer.frame(images, 3))
    assert not np.array_equal(pixels(peer.frame(images, 4)), first)
    assert peer.set("breathing", "") is None
    assert "needs contact pressure" in (peer.set("indentation_mm", 3.0) or "")
    assert peer.set("contact", "pressure") is None
    assert peer.set("indentation_mm", 3.0) is None
    assert not np.array_equal(pixels(peer.frame(images, 5)), at_rest)


def test_what_cannot_be_rendered_is_logged_and_the_node_goes_on(start_node, peer, ros_service):
    from sensor_msgs.msg import Image

    node = start_node(address=ros_service.grpc)
    images = peer.listen(Image, "bmode")
    peer.frame(images, 1)
    peer.pose_until(lambda: "INVALID_POSE: " in node.log(), 2, w=0.0)
    told = "poses must be given in the frame 'scene', got one in 'base_link'"
    peer.pose_until(lambda: told in node.log(), 3, frame="base_link")
    for stamp in range(10, 30):
        peer.pose(stamp, w=0.0)
    peer.frame(images, 4)
    assert {image.header.stamp.sec for image in images} == {1, 4}
    assert node.log().count("INVALID_POSE") == 1, "the log is throttled"


def test_the_node_is_a_lifecycle_node(start_node, peer, ros_service):
    from sensor_msgs.msg import Image

    start_node(address=ros_service.grpc, autostart="false")
    assert peer.transition(CONFIGURE)
    images = peer.listen(Image, "bmode")
    assert peer.node.count_subscribers("/ultragray/probe_pose") == 0
    assert peer.transition(ACTIVATE)
    peer.frame(images, 1)
    assert peer.transition(DEACTIVATE)
    wait_until(lambda: peer.node.count_subscribers("/ultragray/probe_pose") == 0)
    assert peer.transition(ACTIVATE)
    peer.frame(images, 2)
    assert peer.transition(DEACTIVATE)
    assert peer.transition(CLEANUP)
    wait_until(lambda: peer.node.count_publishers("/ultragray/bmode") == 0)


@pytest.mark.parametrize(
    ("parameters", "told"),
    [
        ({"source": "radio"}, "source must be pose or tf, got 'radio'"),
        ({"recording": "liver"}, "recording takes the probe of the images"),
        ({"source": "tf"}, "source must be pose where tf2_ros is not installed"),
        ({"probe": "'{}'"}, "probe must be JSON with a kind"),
        ({"outputs": "['b mode']"}, "outputs must be words such as bmode, got 'b mode'"),
        ({"tls": "true", "root_certificates": "absent.pem"}, "absent.pem cannot be read"),
    ],
)
def test_a_node_that_cannot_start_says_why(start_node, parameters, told):
    node = start_node(**parameters)
    assert node.process.wait(300) == 1
    assert told in node.log()
    assert "Traceback" not in node.log()


class TransformException(Exception):
    """No transform."""


class Buffer:
    """Knows one transform, or none yet."""

    known: Any = None

    def lookup_transform(self, target, source, time):
        assert (target, source, time.nanoseconds) == ("scene", "probe", 0)
        if self.known is None:
            raise TransformException('"scene" passed to lookupTransform argument target_frame does not exist')
        return self.known


class TransformListener:
    def __init__(self, buffer, node):
        self.is_listening = True

    def unregister(self):
        self.is_listening = False


def test_each_transform_becomes_a_pose_once(ros, monkeypatch):
    stand_in = types.ModuleType("tf2_ros")
    for cls in (Buffer, TransformListener, TransformException):
        setattr(stand_in, cls.__name__, cls)
    monkeypatch.setitem(sys.modules, "tf2_ros", stand_in)
    from geometry_msgs.msg import TransformStamped

    from ultragray_ros.newest import Problems
    from ultragray_ros.topics import TransformedPoses

    taken = []
    told = []
    node = ros.create_node("tf_peer")
    poses = TransformedPoses(node, "scene", "probe", rate_hz=200.0, take=taken.append, problems=Problems(told.append))

    def spin_until(condition):
        def turned():
            ros.spin_once(node, timeout_sec=0.1)
            return condition()

        wait_until(turned)

    spin_until(lambda: told)
    assert told[0].startswith("NO_TRANSFORM: ")
    for stamp in (0, 7):  # of a static transform, then of one that moved
        transform = TransformStamped()
        transform.header.frame_id, transform.header.stamp.sec = "scene", stamp
        transform.transform.translation.x = 0.25
        transform.transform.rotation.w, transform.transform.rotation.z = 0.6, 0.8
        Buffer.known = transform
        spin_until(lambda: taken and taken[-1].header.stamp.sec == Buffer.known.header.stamp.sec)
    for _ in range(3):
        ros.spin_once(node, timeout_sec=0.1)
    assert [one.header.stamp.sec for one in taken] == [0, 7]
    assert taken[0].pose.position.x == 0.25
    assert (taken[0].pose.orientation.w, taken[0].pose.orientation.z) == (0.6, 0.8)
    poses.close()
    assert not poses._listener.is_listening
    node.destroy_node()
