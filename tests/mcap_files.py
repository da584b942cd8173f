"""MCAP files as robots and drivers of ROS 2 record them, by MCAP's own writer and the messages' own definitions."""

import json

import numpy as np
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer

from ultragray import LinearProbe
from ultragray.contract import to_dict
from ultragray.exchange import ros_messages as ros
from ultragray.geometry.pose import pose_from_position_quaternion

SECOND = 1_000_000_000
WRITTEN_LATER_NS = 3_000_000  # than the stamp
START_NS = 1_700_000_000 * SECOND
COMPRESSED, TRANSFORM, TRANSFORMS = (
    "sensor_msgs/msg/CompressedImage",
    "geometry_msgs/msg/TransformStamped",
    "tf2_msgs/msg/TFMessage",
)
_LINE = "\n" + "=" * 80 + "\n"
_HEADER = f"{_LINE}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id"
_TIME = f"{_LINE}MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
_TRANSFORM = (
    f"{_LINE}MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation"
    f"{_LINE}MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z"
    f"{_LINE}MSG: geometry_msgs/Quaternion\nfloat64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1"
)
_STAMPED = (
    "# of a child in its parent\nstd_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
)
DEFINITIONS = {
    **ros.DEFINITIONS,
    COMPRESSED: f"std_msgs/Header header # of the exposure\nstring format\nuint8[] data{_HEADER}{_TIME}",
    TRANSFORM: f"{_STAMPED}{_HEADER}{_TIME}{_TRANSFORM}",
    TRANSFORMS: (
        f"geometry_msgs/TransformStamped[] transforms{_LINE}MSG: geometry_msgs/TransformStamped\n{_STAMPED}"
        f"{_HEADER}{_TIME}{_TRANSFORM}"
    ),
}

PROBE = LinearProbe(width_mm=32.0, near_mm=0.0, far_mm=24.0)
GEOMETRY = json.dumps({"probe": to_dict(PROBE)})


def moving_pose(seconds):  # [4, 4] mm
    """A probe that goes along y at 10 mm/s and turns about z by 0.5 rad/s, evenly."""
    turn = (np.cos(0.25 * seconds), 0.0, 0.0, np.sin(0.25 * seconds))
    return pose_from_position_quaternion((5.0, 10.0 * seconds, -3.0), turn)


def image_at(number, height=24, width=32):  # [H, W]
    """A smooth image that tells its number by its corner, which a JPEG keeps nearly."""
    image = np.add.outer(np.arange(height) * 2, np.arange(width)).astype(np.uint8)
    image[:8, :8] = (8 * number + 4) % 256
    return image


def pose_message(pose, time_ns, frame_id="tracker"):
    message = ros.pose_message(pose, time_ns)
    message["header"]["frame_id"] = frame_id
    return message


def image_message(image, time_ns, *, encoding="mono8", padding=0):
    """An image [H, W] or [H, W, C], its rows padded with bytes of no meaning."""
    rows = np.ascontiguousarray(image).view(np.uint8).reshape(len(image), -1)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return {
        "header": ros.header(time_ns, "probe"),
        "height": image.shape[0],
        "width": image.shape[1],
        "encoding": encoding,
        "is_bigendian": 0,
        "step": padded.shape[1],
        "data": padded.tobytes(),
    }


def transform_message(pose, time_ns, parent, child):
    stamped = ros.pose_message(pose, time_ns)["pose"]
    return {
        "header": ros.header(time_ns, parent),
        "child_frame_id": child,
        "transform": {"translation": stamped["position"], "rotation": stamped["orientation"]},
    }


class Bag:
    """A file that is written message by message; `finish` gives it its index."""

    def __init__(self, path, compression=CompressionType.ZSTD, *, enable_crcs=True):
        self.path = path
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=4096, compression=compression, enable_crcs=enable_crcs)
        self._schemas = {}

    def write(self, topic, kind, message, time_ns):
        """Write a message some milliseconds after its stamp, as recorders do."""
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_msgdef(kind, DEFINITIONS[kind])
        self._writer.write_message(topic, self._schemas[kind], message, log_time=time_ns + WRITTEN_LATER_NS)

    def define(self, kind, fields):
        """From here on a kind of message has these fields."""
        self._schemas[kind] = self._writer.register_msgdef(kind, fields)

    def poses(self, topic="/tracker/pose", *, rate_hz=50.0, seconds=1.0):
        """Poses of `moving_pose` from START_NS on."""
        for number in range(int(seconds * rate_hz) + 1):
            time_ns = START_NS + round(number / rate_hz * SECOND)
            self.write(topic, ros.POSE, pose_message(moving_pose(number / rate_hz), time_ns), time_ns)

    def images(self, topic="/us/image", *, count=12, begin_s=0.011, step_s=0.07):
        """Images of `image_at`, whose stamps are those of no pose."""
        for number in range(count):
            time_ns = image_time_ns(number, begin_s, step_s)
            self.write(topic, ros.IMAGE, image_message(image_at(number), time_ns), time_ns)

    def geometry(self, text=GEOMETRY, topic="/us/geometry", time_ns=START_NS):
        """A message of the geometry."""
        self.write(topic, ros.TEXT, {"data": text}, time_ns)

    def finish(self):
        """Write the index."""
        self._writer.finish()
        return self.leave()

    def leave(self):
        """Leave the file as a recorder that was killed does."""
        self._file.close()
        return self.path


def image_time_ns(number, begin_s=0.011, step_s=0.07):
    return START_NS + round((begin_s + number * step_s) * SECOND)


def recorded(path):
    """A sweep of 12 images at 14 Hz and poses at 50 Hz."""
    bag = Bag(path)
    bag.geometry()
    bag.poses()
    bag.images()
    return bag.finish()
