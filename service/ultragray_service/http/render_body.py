"""The poses and the probe of a render request, checked."""

from __future__ import annotations

from ultragray.display.settings import AS_RENDERED, Display
from ultragray.errors import InvalidArgument, InvalidPose
from ultragray.pose import pose_from_position_quaternion
from ultragray.probe import FloatArray, Probe
from ultragray_workers.pool.types import Below, Trust

from ..core.requests import check_pose_count, field_under, gather_poses, one_pose
from .schemas import PoseBody, RenderBody
from .stream_schemas import StreamSettings


def poses_as_written(body: RenderBody, limit: int) -> list[tuple[str, PoseBody]]:
    """The poses, each with the path it has in the body. Raises InvalidArgument, TooManyPoses."""
    if (body.pose is None) == (body.poses is None):
        raise InvalidArgument("the body must hold exactly one of pose and poses", field="pose")
    if body.pose is not None:
        return [("pose", body.pose)]
    poses = body.poses or []
    check_pose_count(len(poses), limit)
    return [(f"poses[{index}]", pose) for index, pose in enumerate(poses)]


async def checked_poses(written: list[tuple[str, PoseBody]]) -> FloatArray:  # [C, 4, 4] mm
    """The exact poses. Raises InvalidPose, naming the pose."""
    return await gather_poses(len(written), lambda index: checked_pose(*written[index]))


def checked_pose(path: str, pose: PoseBody) -> FloatArray:  # [4, 4] mm
    """The exact pose. Raises InvalidPose, naming the part of `path` to blame."""
    if pose.matrix is not None:
        if pose.position_mm is not None or pose.quaternion is not None:
            raise InvalidPose(f"{path} must hold either matrix, or position_mm and quaternion, not both", field=path)
        return one_pose(pose.matrix, field=f"{path}.matrix")
    if pose.position_mm is None and pose.quaternion is None:
        raise InvalidPose(f"{path} must hold either matrix, or position_mm and quaternion", field=path)
    if pose.position_mm is None:
        raise InvalidPose(f"{path}.position_mm is required beside quaternion", field=f"{path}.position_mm")
    if pose.quaternion is None:
        raise InvalidPose(f"{path}.quaternion is required beside position_mm", field=f"{path}.quaternion")
    p, q = pose.position_mm, pose.quaternion
    return pose_from_position_quaternion((p.x, p.y, p.z), (q.w, q.x, q.y, q.z), field=path)


def asked_display(body: RenderBody | StreamSettings) -> Display:
    """The display settings of the body. Raises InvalidArgument, naming the number."""
    if body.display is None:
        return AS_RENDERED
    with field_under("display"):
        return body.display.display()


def asked_trust(body: RenderBody | StreamSettings) -> Trust:
    """The confidence that the body asks for, not yet checked."""
    return Trust(body.min_confidence, Below(body.below_min_confidence))


def asked_probe(body: RenderBody | StreamSettings) -> Probe | None:
    """The probe of the body. Raises InvalidProbe, naming the number."""
    if body.probe is None:
        return None
    with field_under("probe"):
        return body.probe.probe()
