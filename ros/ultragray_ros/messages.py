"""Between messages of ROS and those of the client: the one place where metres become millimetres, and back.

Convention. A pose takes points of the probe's frame (x lateral, y elevation, z depth) to the scene's. Worked value: the
position (0, 0, 0.01) m is (0, 0, 10) mm; orientations are x, y, z, w in ROS and named here.
"""

from __future__ import annotations

import io
import json
from array import array
from dataclasses import asdict

import numpy as np
import numpy.typing as npt
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, PoseArray, PoseStamped, TransformStamped
from geometry_msgs.msg import Quaternion as Orientation
from PIL import Image as Picture
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header, String

from ultragray_client import Frame, Placement, Quaternion, ViewPlan, quaternion_from_pose
from ultragray_client.errors import InvalidArgument
from ultragray_client.frames import origin_of
from ultragray_client.recording.messages import geometry_document

MM_PER_M = 1000.0
JPEG_QUALITY = 95
ENCODING = "mono8"

Pixels = npt.NDArray[np.uint8]


def placement(stamped: PoseStamped) -> Placement:
    """The pose of the probe, in mm; the service checks it."""
    position, turn = stamped.pose.position, stamped.pose.orientation
    return Placement(
        (MM_PER_M * position.x, MM_PER_M * position.y, MM_PER_M * position.z),
        Quaternion(w=turn.w, x=turn.x, y=turn.y, z=turn.z),
    )


def stamped_pose(transform: TransformStamped) -> PoseStamped:
    """The pose of the child's frame in the parent's, with the transform's stamp."""
    pose = PoseStamped(header=transform.header)
    moved, position = transform.transform.translation, pose.pose.position
    position.x, position.y, position.z = moved.x, moved.y, moved.z
    pose.pose.orientation = transform.transform.rotation
    return pose


def planned_poses(plan: ViewPlan, header: Header) -> PoseArray:
    """The views of a plan in the order to travel them; with a registration those of the flange in its base."""
    poses = []
    for view in plan.views:
        matrix = view.pose if view.flange_to_base is None else view.flange_to_base
        w, x, y, z = quaternion_from_pose(matrix)
        place = dict(zip("xyz", (matrix[:3, 3] / MM_PER_M).tolist(), strict=True))
        poses.append(Pose(position=Point(**place), orientation=Orientation(w=w, x=x, y=y, z=z)))
    return PoseArray(header=header, poses=poses)


def plan_report(plan: ViewPlan) -> String:
    """What a plan is expected to gain, as JSON: the gains in the order of its poses, in all, and the way in metres."""
    gains = [view.gain for view in plan.views]
    document = {"gains": gains, "before": plan.before, "after": plan.after, "path_m": plan.path_mm / MM_PER_M}
    return String(data=json.dumps(document))


def real_pixels(image: Image) -> Pixels:  # [H, W]
    """The pixels of an image of a probe. Raises InvalidArgument for one that is not grey, of 8 bits."""
    if image.encoding not in (ENCODING, "8UC1") or len(image.data) != image.height * image.step:
        raise InvalidArgument(
            f"real images must be mono8, {image.height} rows of {image.step} bytes, got {len(image.data)} bytes of "
            f"{image.encoding}",
            field="image",
        )
    return np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)[:, : image.width]


def image(pixels: Pixels, header: Header) -> Image:  # [H, W]
    """The pixels as they are, 8-bit grey."""
    height, width = pixels.shape
    data = array("B", pixels.tobytes())  # rclpy copies an array at once, and checks other sequences byte by byte
    return Image(header=header, height=height, width=width, encoding=ENCODING, is_bigendian=0, step=width, data=data)


def compressed_image(pixels: Pixels, header: Header) -> CompressedImage:  # [H, W]
    """The pixels as a JPEG file, which changes them a little."""
    file = io.BytesIO()
    Picture.fromarray(pixels).save(file, "JPEG", quality=JPEG_QUALITY)
    return CompressedImage(header=header, format=f"{ENCODING}; jpeg compressed ", data=array("B", file.getvalue()))


def confidence(frame: Frame, header: Header, *, least: float | None, replaced: int) -> DiagnosticArray:
    """How far a frame can be trusted: WARN where its confidence is not known, or below `least`.

    The values are the confidence figures of the frame, its latency in ms, the poses that it replaced, and how its pose
    was foretold; those that are not known are missing.
    """
    extrapolation = frame.extrapolation
    known = extrapolation.confidence is not None
    is_fine = extrapolation.confidence is not None and (least is None or extrapolation.confidence >= least)
    foretold = {} if frame.prediction is None else asdict(frame.prediction)
    values = {**asdict(extrapolation), "latency_ms": frame.latency_ms, "replaced_poses": replaced, **foretold}
    status = DiagnosticStatus(
        level=DiagnosticStatus.OK if is_fine else DiagnosticStatus.WARN,
        name=f"ultragray: {frame.scene}",
        message=f"confidence {extrapolation.confidence:.2f}" if known else "the scene cannot tell its confidence",
        hardware_id=frame.scene_sha256,
        values=[KeyValue(key=key, value=f"{value:g}") for key, value in values.items() if value is not None],
    )
    return DiagnosticArray(header=header, status=[status])


def geometry(frame: Frame, frame_id: str) -> String:
    """JSON: where the pixels lie in the frame of the probe, and what was rendered (`geometry_document`)."""
    return String(data=json.dumps(geometry_document(origin_of(frame), frame_id)))
