"""Poses as the backends take them: cm about the scene's centre, and the way back for a gradient."""

from __future__ import annotations

from typing import Any, TypeAlias

import torch
from torch import Tensor

from ultragray.pose import check_poses
from ultragray.probe import FloatArray
from ultragray.scene import GaussianScene

ScenePoses: TypeAlias = FloatArray | Tensor  # [C, 4, 4]; a tensor, float64 on the CPU, where it wants a gradient


def scene_poses(scene: GaussianScene, poses: Any) -> ScenePoses:  # [C, 4, 4] or [4, 4] mm -> [C, 4, 4] cm
    """Poses of the sweep's frame, made exactly rigid, in the scene's own; the graph of a tensor is kept.

    Raises InvalidPose.
    """
    exact = check_poses(poses)
    if isinstance(poses, Tensor) and poses.requires_grad and torch.is_grad_enabled():
        made: Tensor = _Rigid.apply(poses, exact, scene.poses_to_scene_cm(exact))  # type: ignore[no-untyped-call]
        return made
    return scene.poses_to_scene_cm(exact)


def want_gradient(poses: ScenePoses) -> bool:
    """Whether a loss is to be differentiated by these poses."""
    return isinstance(poses, Tensor) and poses.requires_grad and torch.is_grad_enabled()


def as_array(poses: ScenePoses) -> FloatArray:  # [C, 4, 4]
    """The numbers alone."""
    array: FloatArray = poses.detach().numpy() if isinstance(poses, Tensor) else poses
    return array


def gradient_by_poses(poses: Tensor, by_motion: Tensor) -> Tensor:  # [C, 4, 4], [C, 2, 3] -> [C, 4, 4]
    """By the entries of poses, from what kernels give: by a shift (cm) and a turn (radians, about the probe's origin).

    A turn ω moves a rotation R by [ω]R; of all matrices whose product with that is the same, ½[turn]R is the shortest.
    """
    by_poses = torch.zeros_like(poses)
    by_poses[:, :3, 3] = by_motion[:, 0]
    by_poses[:, :3, :3] = 0.5 * torch.linalg.cross(by_motion[:, 1, :, None], poses[:, :3, :3], dim=1)
    return by_poses


class _Rigid(torch.autograd.Function):
    """The nearest rigid transforms and their change of units.

    What a frame is for a matrix that is no rotation is not defined, so the gradient by the nine entries of a rotation R
    is that of the nearest rotation: of dL/dR the part R·A with A antisymmetric, which every way of moving a rotation
    sees (docs/physics.md §4). Exact for a rotation; within 1e-3 for one that had to be corrected by as much.
    """

    @staticmethod
    def forward(ctx: Any, poses: Tensor, exact: FloatArray, exact_cm: FloatArray) -> Tensor:
        ctx.like, ctx.rotations = poses.detach(), torch.from_numpy(exact[:, :3, :3])
        return torch.from_numpy(exact_cm)

    @staticmethod
    def backward(ctx: Any, by_cm: Tensor) -> tuple[Tensor, None, None]:
        rotations, by_poses = ctx.rotations, torch.zeros_like(by_cm)
        by_turn = rotations.transpose(1, 2) @ by_cm[:, :3, :3]
        by_poses[:, :3, :3] = rotations @ (by_turn - by_turn.transpose(1, 2)) / 2.0
        by_poses[:, :3, 3] = by_cm[:, :3, 3] / 10.0
        return by_poses.reshape(ctx.like.shape).to(ctx.like), None, None
