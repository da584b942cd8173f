"""The poses of a render job. Free of torch."""

from __future__ import annotations

import numpy as np

from ultragray.errors import InvalidArgument
from ultragray.pose import check_poses
from ultragray.probe import FloatArray

from .specification import PoseSampler, RenderJob


def poses_of(job: RenderJob, training_poses: FloatArray) -> FloatArray:  # [P, 4, 4] -> [C, 4, 4] mm
    """The poses that a job asks for; the same job gives the same.

    Raises InvalidArgument where a sampler needs training poses and the scene has none.
    """
    if job.sampler is None:
        return check_poses(job.poses)
    if not len(training_poses):
        raise InvalidArgument(f"sampler needs training poses, the scene {job.scene!r} has none", field="sampler")
    if job.sampler.kind == "training":
        return training_poses
    return jittered(training_poses, job.sampler)


def jittered(poses: FloatArray, sampler: PoseSampler) -> FloatArray:  # [P, 4, 4] -> [C, 4, 4] mm
    """Random poses near the given ones: see PoseSampler."""
    assert sampler.count is not None
    random = np.random.default_rng(sampler.seed)
    moved = poses[random.integers(len(poses), size=sampler.count)]
    axes = random.normal(size=(sampler.count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.radians(random.normal(0.0, sampler.rotation_deg, sampler.count))
    moved[:, :3, :3] = moved[:, :3, :3] @ _rotations(axes, angles)
    moved[:, :3, 3] += random.normal(0.0, sampler.translation_mm, (sampler.count, 3))
    return check_poses(moved)


def _rotations(axes: FloatArray, angles: FloatArray) -> FloatArray:  # [C, 3] of length 1, [C] rad -> [C, 3, 3]
    """Rodrigues' formula: 1 + sin a K + (1 − cos a) K²."""
    x, y, z = axes.T
    nothing = np.zeros_like(x)
    cross = np.stack([nothing, -z, y, z, nothing, -x, -y, x, nothing], axis=1).reshape(-1, 3, 3)
    sine, versine = np.sin(angles)[:, None, None], (1.0 - np.cos(angles))[:, None, None]
    rotations: FloatArray = np.eye(3) + sine * cross + versine * (cross @ cross)
    return rotations
