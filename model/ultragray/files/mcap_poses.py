"""Poses in MCAP files: geometry_msgs/PoseStamped of ROS 2, metres, such as `ros2 bag record -s mcap` writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ultragray.errors import InvalidPose
from ultragray.exchange.ros_fields import check_fields, pose_of_message
from ultragray.exchange.ros_messages import POSE
from ultragray.installation import missing_extra
from ultragray.probe import FloatArray

PREFERRED = "/probe_pose"  # the end of the topic of the ROS 2 node


def read_mcap_poses(path: Path) -> FloatArray:  # [P, 4, 4]
    """The poses of the one topic of PoseStamped, by their time, mm; of several that whose name ends in /probe_pose.

    Raises ValueError with the reason for a file that cannot be read, ExtraMissing, OSError.
    """
    try:
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    except ImportError as error:
        raise missing_extra(error, "poses of an .mcap file", field="poses") from error
    with path.open("rb") as file:
        try:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            topic = _topic(reader.get_summary())
            messages = [found.decoded_message for found in reader.iter_decoded_messages(topics=[topic])]
        except (OSError, ValueError):
            raise
        except Exception as error:  # the library has many kinds for a file that is not whole
            raise ValueError(f"it is no whole MCAP file ({error or type(error).__name__})") from error
    for message in messages:
        check_fields(message, POSE)
    try:
        poses = [pose_of_message(message, field=f"poses[{place}]") for place, message in enumerate(messages)]
    except InvalidPose as error:
        raise ValueError(error.detail) from error
    return np.array(poses).reshape(-1, 4, 4)


def _topic(summary: Any) -> str:
    """The topic that holds the poses of the probe."""
    if summary is None:
        raise ValueError("it has no summary: its writing was not finished")
    kinds = {number: schema.name for number, schema in summary.schemas.items()}
    channels = {channel.topic: kinds.get(channel.schema_id) for channel in summary.channels.values()}
    topics = sorted(topic for topic, kind in channels.items() if kind == POSE)
    chosen = topics if len(topics) == 1 else [topic for topic in topics if topic.endswith(PREFERRED)]
    if len(chosen) != 1:
        others = ", ".join(topics) or ", ".join(f"{topic} ({kind})" for topic, kind in sorted(channels.items()))
        raise ValueError(f"one topic of {POSE} is needed, or one that ends in {PREFERRED}; it has: {others or 'none'}")
    return str(chosen[0])
