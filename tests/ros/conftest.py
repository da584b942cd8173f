"""A peer in ROS 2 of the node, which runs in a process of its own; all without leaving this machine.

The tests of this folder that ask for `peer` are skipped where rclpy is not installed: `make test-ros` installs it.
"""

import os
import subprocess
import sys
import threading
import warnings

import pytest

from ..service.conftest import data_folder, demo_scene, start_service, start_shared_service
from ..surroundings import ROOT
from ..waiting import wait_until

__all__ = ["data_folder", "demo_scene", "start_service", "start_shared_service"]

# Of this process's own, so that tests that run at the same time do not hear each other; 101 is the highest for all.
SURROUNDINGS = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(os.getpid() % 101 + 1)}
NODE = "/ultragray"


@pytest.fixture(scope="session")
def ros_service(start_shared_service):
    return start_shared_service()


@pytest.fixture(scope="session")
def ros(home_of_the_tests):
    """rclpy, ready to be used; the test is skipped where it is not installed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of the parser that its messages are loaded with
        rclpy = pytest.importorskip("rclpy", reason="there is no ROS 2 here: make test-ros installs its wheels")
        os.environ.update(SURROUNDINGS)
        rclpy.init()
        rclpy.create_node("first").destroy_node()  # loads what warns
    yield rclpy
    rclpy.try_shutdown()


class Peer:
    """A node that publishes poses and keeps what comes back, by topic."""

    def __init__(self, rclpy):
        from geometry_msgs.msg import PoseStamped
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import qos_profile_sensor_data

        self.node = rclpy.create_node("peer")
        self.quality = qos_profile_sensor_data
        self.heard = {}
        self._poses = self.node.create_publisher(PoseStamped, f"{NODE}/probe_pose", 10)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin)
        self._thread.start()

    def listen(self, kind, topic, quality=None):
        """What comes on a topic of the node from now on."""
        heard = self.heard.setdefault(topic, [])
        self.node.create_subscription(kind, f"{NODE}/{topic}", heard.append, quality or self.quality)
        wait_until(lambda: self.node.count_publishers(f"{NODE}/{topic}"))
        return heard

    def pose(self, stamp, *, nanosec=0, y_m=0.0, frame="scene", w=1.0):
        """Publish a pose with a stamp of so many seconds, when the node listens."""
        from geometry_msgs.msg import PoseStamped

        message = PoseStamped()
        message.header.frame_id, message.header.stamp.sec = frame, stamp
        message.header.stamp.nanosec = nanosec
        message.pose.position.y, message.pose.orientation.w = y_m, w
        wait_until(self._poses.get_subscription_count)
        self._poses.publish(message)

    def frame(self, heard, stamp, **pose):
        """What comes for a pose."""
        return self.pose_until(
            lambda: next((one for one in list(heard) if one.header.stamp.sec == stamp), None), stamp, **pose
        )

    def pose_until(self, condition, stamp, **pose):
        """The first true answer of `condition`. The pose is published again until then, as what comes before both sides
        know of each other is lost.
        """

        def answer():
            if not (found := condition()):
                self.pose(stamp, **pose)
            return found

        return wait_until(answer, every_s=0.1)

    def call(self, kind, service, **fields):
        """The answer of a service of the node."""
        client = self.node.create_client(kind, f"{NODE}/{service}")
        wait_until(client.service_is_ready)
        done = client.call_async(kind.Request(**fields))
        wait_until(done.done)
        self.node.destroy_client(client)
        return done.result()

    def set(self, name, value):
        """Set a parameter of the node; why it was refused, or None."""
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter

        message = Parameter(name, value=value).to_parameter_msg()
        (result,) = self.call(SetParameters, "set_parameters", parameters=[message]).results
        return None if result.successful else result.reason

    def transition(self, number):
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        return bool(self.call(ChangeState, "change_state", transition=Transition(id=number)).success)

    def close(self):
        self._executor.shutdown()
        self._thread.join()
        self.node.destroy_node()


@pytest.fixture
def peer(ros):
    peer = Peer(ros)
    yield peer
    peer.close()


class RunningNode:
    """`ultragray-ros` in a process of its own."""

    def __init__(self, log, parameters):
        arguments = [part for name, value in parameters.items() for part in ("-p", f"{name}:={value}")]
        self._log = log
        with log.open("wb") as file:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "ultragray_ros.node", "--ros-args", *arguments],
                env={**os.environ, "PYTHONPATH": str(ROOT / "ros")},
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
            )

    def log(self):
        return self._log.read_text()

    def stop(self):
        """The exit code after an interrupt."""
        self.process.send_signal(2)
        return self.process.wait(300)


@pytest.fixture
def start_node(ros, tmp_path):
    started = []

    def start(**parameters):
        started.append(RunningNode(tmp_path / f"node{len(started)}.log", parameters))
        return started[-1]

    yield start
    for node in started:
        if node.process.poll() is None:
            node.process.terminate()
            node.process.wait(300)
