"""Pose refinement of ImplicitVol: three angles and three translations of each training frame, learned with the field.

Convention. Places are in the field's coordinates: mm less the scene's centre, over half the height of an image. A frame
is turned about the middle of its image, then put there. Its rotation is M Rz Ry Rx, M the mean rotation of the tracked
frames: so the angles are small, and far from ±90° about y, where the three are no longer independent.

Gauge. Field and frames may move together without a change of any training frame, and the paper leaves that motion open.
Here it is taken out where a frame is rendered: `common_motion` is the rigid motion that carries the tracked frames onto
the refined ones best, and a held-out pose, which is given in the tracker's frame, is moved by it.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from ultragray.datasets.sweep import Sweep
from ultragray.evaluation.compounding import mean_axes
from ultragray.methods.parts.space import as_tensor
from ultragray.probe import FloatArray

MIDDLE = np.array(0.5)  # of an image, down and across


class FramePoses(nn.Module):
    """The poses of the training frames, which begin as the tracker's."""

    def __init__(self, sweep: Sweep, centre_mm: FloatArray, half_height_mm: float, device: torch.device) -> None:
        super().__init__()
        axes = mean_axes(sweep.poses)
        middle_mm = sweep.probe.points_mm(MIDDLE, MIDDLE)
        middles_mm = sweep.poses[:, :3, :3] @ middle_mm + sweep.poses[:, :3, 3]
        self.angles = nn.Parameter(as_tensor(angles_of(axes.T @ sweep.poses[:, :3, :3]), device))  # [F, 3] about x y z
        self.shifts = nn.Parameter(as_tensor((middles_mm - centre_mm) / half_height_mm, device))  # [F, 3]
        self._axes = as_tensor(axes, device)
        self._middle_mm, self._half_height_mm = as_tensor(middle_mm, device), half_height_mm
        self._corners_mm = as_tensor(sweep.probe.corners_mm(), device)  # [K, 3]
        self._tracked_corners = as_tensor((sweep.corners_mm() - centre_mm) / half_height_mm, device)  # [F, K, 3]

    def points(self, place: int, pixels_mm: Tensor) -> Tensor:  # [..., 3] -> [..., 3]
        """Points of the probe frame (mm), seen from a training frame's pose, in the field's coordinates."""
        centred = (pixels_mm - self._middle_mm) / self._half_height_mm
        return centred @ (self._axes @ rotation_of(self.angles[place])).T + self.shifts[place]

    def common_motion(self) -> tuple[Tensor, Tensor]:  # [3, 3], [3]
        """Rotation and translation, in the field's coordinates, that carry tracked corners onto refined ones best."""
        centred = (self._corners_mm - self._middle_mm) / self._half_height_mm
        refined = centred @ (self._axes @ rotation_of(self.angles)).mT + self.shifts[:, None]  # [F, K, 3]
        before, after = self._tracked_corners.reshape(-1, 3).double(), refined.reshape(-1, 3).double()
        mean_before, mean_after = before.mean(dim=0), after.mean(dim=0)
        left, _, right = torch.linalg.svd((after - mean_after).T @ (before - mean_before))
        signs = torch.ones(3, dtype=left.dtype, device=left.device)
        signs[2] = torch.linalg.det(left @ right)
        rotation = left @ torch.diag(signs) @ right
        return rotation.float(), (mean_after - rotation @ mean_before).float()


def rotation_of(angles: Tensor) -> Tensor:  # [..., 3] about x, y, z -> [..., 3, 3]
    """Rz Ry Rx."""
    (cx, cy, cz), (sx, sy, sz) = angles.cos().unbind(-1), angles.sin().unbind(-1)
    rows = (
        torch.stack([cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx], dim=-1),
        torch.stack([sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx], dim=-1),
        torch.stack([-sy, cy * sx, cy * cx], dim=-1),
    )
    return torch.stack(rows, dim=-2)


def angles_of(rotations: FloatArray) -> FloatArray:  # [F, 3, 3] -> [F, 3] about x, y, z
    """Inverse of `rotation_of`."""
    about_x = np.arctan2(rotations[:, 2, 1], rotations[:, 2, 2])
    about_y = np.arcsin(np.clip(-rotations[:, 2, 0], -1.0, 1.0))
    about_z = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    return np.stack([about_x, about_y, about_z], axis=-1)
