"""Poses in files, probe→scene (camera-to-world): `.npy` arrays or `.json` lists in mm, `.mcap` of ROS 2 in metres."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ultragray.errors import InvalidPose
from ultragray.exchange.ros_fields import check_fields, pose_of_message
from ultragray.exchange.ros_messages import POSE
from ultragray.files import map_npy
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray
from ultragray.installation import missing_extra


def load_poses(path: str | Path) -> FloatArray:  # [P, 4, 4]
    """The poses of a `.npy`, `.json` or `.mcap` file as exact float64 [P, 4, 4], mm.

    An array is [P, 4, 4], [P, 3, 4], or one pose [4, 4] or [3, 4]; a missing last row is 0 0 0 1. An `.mcap` file has
    one topic of geometry_msgs/PoseStamped, in metres. Raises InvalidPose, naming the file, the pose and what was
    expected, and ExtraMissing; never runs code from the file.
    """
    path = Path(path)
    array = read_pose_array(path)
    try:
        poses = check_poses(array, field="poses")
    except InvalidPose as error:
        raise InvalidPose(f"{path}: {error}", field="poses") from error
    if not len(poses):
        raise InvalidPose(f"{path}: it holds no poses", field="poses")
    return poses


def read_pose_array(path: str | Path) -> npt.NDArray[Any]:
    """The array of a `.npy`, `.json` or `.mcap` file, the last row completed, not yet checked for being poses.

    For a caller that checks them itself, frame by frame. Raises InvalidPose, naming a file that cannot be read.
    """
    path = Path(path)
    try:
        return _with_last_row(_read(path))
    except (OSError, ValueError, EOFError, RecursionError, MemoryError) as error:
        raise InvalidPose(f"{path}: {_reason(error)}", field="poses") from error


def read_frame_poses(path: str | Path) -> npt.NDArray[Any]:
    """As `read_pose_array`, where a frame may have no pose: `null` in JSON, NaN in an array. Those are NaN here."""
    path = Path(path)
    if path.suffix != ".json":
        return read_pose_array(path)
    try:
        document = _read(path)
        shape = next((np.shape(pose) for pose in document if pose is not None), (4, 4))
        missing = np.full(shape, np.nan).tolist()
        return _with_last_row([missing if pose is None else pose for pose in document])
    except (OSError, ValueError, RecursionError, MemoryError) as error:
        raise InvalidPose(f"{path}: {_reason(error)}", field="poses") from error


def frames_with_pose(poses: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:  # [F, 4, 4] -> [F]
    """Whether each frame has a pose: one of NaN alone is none."""
    has_pose: npt.NDArray[np.bool_] = ~np.isnan(poses[:, :3]).all(axis=(1, 2))
    return has_pose


def _read(path: Path) -> Any:
    if not path.is_file():  # a pipe or a device would never end
        raise FileNotFoundError
    if path.suffix == ".json":
        document = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(document, list):
            raise ValueError(
                "it must hold a list of lists of numbers, one pose [4, 4] or [3, 4], or P of them, not "
                f"{json.dumps(document)[:60]}"
            )
        return document
    if path.suffix == ".npy":
        return map_npy(path)
    if path.suffix == ".mcap":
        return read_mcap_poses(path)
    raise ValueError("poses are read from .npy, .json and .mcap files")


def _with_last_row(poses: Any) -> npt.NDArray[Any]:
    array = np.asarray(poses)
    if array.ndim not in (2, 3) or array.shape[-2:] != (3, 4) or array.dtype.kind not in "fiu":
        return array
    last = np.broadcast_to(np.array([0.0, 0.0, 0.0, 1.0]), (*array.shape[:-2], 1, 4))
    return np.concatenate([array, last], axis=-2)


def _reason(error: BaseException) -> str:
    if isinstance(error, FileNotFoundError):
        return "no such file"
    if isinstance(error, RecursionError):
        return "it nests too deeply"
    return f"not a file of poses that can be read: {error}"


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
            messages = [record.decoded_message for record in reader.iter_decoded_messages(topics=[topic])]
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
