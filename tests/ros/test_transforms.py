"""Poses from transforms. tf2_ros has no wheel: a stand-in of its names gives the transforms; all else is ROS's."""

import sys
import types
from typing import Any

import pytest

from ..waiting import wait_until

pytestmark = pytest.mark.slow


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
