"""Poses of MCAP files that others wrote, and files that hold none."""

import numpy as np
import pytest
from mcap_ros2.writer import Writer

from ultragray.errors import InvalidPose
from ultragray.exchange.poses import load_poses
from ultragray.exchange.ros_messages import DEFINITIONS, IMAGE, POSE, pose_message

from ...mcap_files import Bag


def record(path, topics, *, kind=POSE, finish=True):
    """A file with messages (time in ns, message) by topic."""
    with path.open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef(kind, DEFINITIONS[kind])
        for topic, messages in topics.items():
            for time_ns, message in messages:
                writer.write_message(topic, schema, message, log_time=time_ns)
        if finish:
            writer.finish()
    return path


def at(x_mm, time_ns=0, **turn):
    pose = np.eye(4)
    pose[0, 3] = x_mm
    message = pose_message(pose, time_ns)
    message["pose"]["orientation"] |= turn
    return time_ns, message


def test_poses_come_in_the_order_of_their_time(tmp_path):
    path = record(tmp_path / "bag.mcap", {"/tracker/pose": [at(3.0, 30), at(1.0, 10), at(2.0, 20)]})
    assert load_poses(path)[:, 0, 3].tolist() == pytest.approx([1.0, 2.0, 3.0])


def test_of_several_topics_that_of_the_probe_is_taken(tmp_path):
    topics = {"/robot/flange": [at(9.0)], "/ultragray/probe_pose": [at(1.0)]}
    assert load_poses(record(tmp_path / "bag.mcap", topics))[:, 0, 3].tolist() == pytest.approx([1.0])


@pytest.mark.parametrize(
    ("topics", "told"),
    [
        ({"/a": [at(1.0)], "/b": [at(1.0)]}, r"one topic of geometry_msgs/msg/PoseStamped is needed.*it has: /a, /b"),
        ({}, "it has: none"),
        ({"/a": [at(1.0), at(1.0, 1, w=0.5)]}, r"poses\[1\].quaternion must have norm 1"),
        ({"/a": [at(float("nan"))]}, r"poses\[0\] must be finite"),
    ],
)
def test_what_holds_no_poses_is_refused_with_its_name(tmp_path, topics, told):
    with pytest.raises(InvalidPose, match=rf"bag.mcap.*{told}"):
        load_poses(record(tmp_path / "bag.mcap", topics))


def test_a_file_of_images_alone_tells_what_it_has(tmp_path):
    image = {"header": at(0.0)[1]["header"], "height": 1, "width": 1, "encoding": "mono8", "is_bigendian": 0}
    topics = {"/camera": [(0, {**image, "step": 1, "data": b"0"})]}
    with pytest.raises(InvalidPose, match=r"it has: /camera \(sensor_msgs/msg/Image\)"):
        load_poses(record(tmp_path / "bag.mcap", topics, kind=IMAGE))


def test_what_is_only_called_a_pose_is_told(tmp_path):
    bag = Bag(tmp_path / "bag.mcap")
    bag.define(POSE, "string text")
    bag.write("/a", POSE, {"text": "here"}, 0)
    with pytest.raises(InvalidPose, match=r"bag\.mcap.*what it calls geometry_msgs/msg/PoseStamped is another kind"):
        load_poses(bag.finish())


def test_a_file_that_is_not_whole_is_refused(tmp_path):
    path = record(tmp_path / "bag.mcap", {"/a": [at(1.0)] * 50})
    whole = path.read_bytes()
    for length in (0, 5, 40, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(InvalidPose, match=r"bag\.mcap"):
            load_poses(path)
    record(path, {"/a": [at(1.0)]}, finish=False)
    with pytest.raises(InvalidPose, match=r"bag\.mcap"):
        load_poses(path)
