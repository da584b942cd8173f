"""The poses and the probe of a render request, checked."""

from __future__ import annotations

from ultragray.contract import under
from ultragray.errors import InvalidArgument, InvalidPose
from ultragray.pose import pose_from_position_quaternion
from ultragray.probe import FloatArray
from ultragray.settings import Below, FrameSettings

from ..core.requests import check_pose_count, gather_poses, one_pose
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


def asked_settings(body: RenderBody | StreamSettings) -> FrameSettings:
    """What the body asks for, apart from the poses. Raises InvalidArgument, naming the number."""
    probe = display = None
    if body.probe is not None:
        with under("probe"):
            probe = body.probe.probe()
    if body.display is not None:
        with under("display"):
            display = body.display.display()
    return FrameSettings(
        height=body.height,
        width=body.width,
        probe=probe,
        min_confidence=body.min_confidence,
        below_min_confidence=Below(body.below_min_confidence),
        display=display,
        outputs=tuple(body.outputs),
    )
