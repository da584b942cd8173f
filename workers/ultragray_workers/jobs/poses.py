"""The poses of a render job. Free of torch."""

from __future__ import annotations

from collections.abc import Sequence

from ultragray.confidence import Extrapolation, require_confidence
from ultragray.errors import InvalidArgument
from ultragray.pose import check_poses
from ultragray.probe import FloatArray, Probe
from ultragray.samplers import Assess, confident_poses

from .specification import RenderJob


def poses_of(job: RenderJob, training_poses: FloatArray, probe: Probe) -> FloatArray:  # [P, 4, 4] -> [C, 4, 4] mm
    """The poses that a job asks for, whatever their confidence; the same job, training poses and probe give the same.

    Raises InvalidArgument where a sampler needs training poses and the scene has none, or cannot use those it has.
    """
    if job.sampler is None:
        return check_poses(job.poses)
    return job.sampler.poses(_base(job, training_poses), probe)


def assessed_poses(
    job: RenderJob, training_poses: FloatArray, probe: Probe, assess: Assess
) -> tuple[FloatArray, Sequence[Extrapolation]]:  # [P, 4, 4] -> [C, 4, 4] mm, [C]
    """The poses that a job is to render, each with its `min_confidence`, and what `assess` tells of them.

    Raises LowConfidence for a given pose below it and for a sampler that keeps too few, and what `poses_of` raises.
    """
    if job.sampler is not None and job.min_confidence is not None:
        return confident_poses(job.sampler, _base(job, training_poses), probe, assess, job.min_confidence)
    poses = poses_of(job, training_poses, probe)
    extrapolations = assess(poses)
    require_confidence(extrapolations, job.min_confidence)
    return poses, extrapolations


def _base(job: RenderJob, training_poses: FloatArray) -> FloatArray:  # [P, 4, 4] -> [P, 4, 4]
    if job.poses is not None:
        return check_poses(job.poses)
    if not len(training_poses):
        raise InvalidArgument(f"sampler needs training poses, the scene {job.scene!r} has none", field="sampler")
    return training_poses
