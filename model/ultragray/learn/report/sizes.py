"""How far corrections moved the frames of a scene. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import turn_angles_rad

if TYPE_CHECKING:
    from ultragray.scene.gaussians import GaussianScene
    from ultragray.scene.info import SceneHeader


@dataclass(frozen=True, eq=False)
class CorrectionSizes:
    """Of each training frame: the shift of the probe's origin and the turn of the probe."""

    shift_mm: FloatArray  # [P]
    turn_deg: FloatArray  # [P]

    @classmethod
    def of(cls, scene: SceneHeader | GaussianScene) -> CorrectionSizes | None:
        """From the tracker's poses to those that the scene was trained on; None where these are the same."""
        tracked, corrections, rest = scene.training_poses, scene.pose_corrections, scene.rest_poses
        if corrections is None and rest is None:
            return None
        tracker_poses = tracked if corrections is None else np.linalg.inv(corrections) @ tracked
        trained = tracked if rest is None else rest
        shifts = np.linalg.norm(trained[:, :3, 3] - tracker_poses[:, :3, 3], axis=1)
        return cls(shifts, np.degrees(turn_angles_rad(trained[:, :3, :3], tracker_poses[:, :3, :3])))

    def to_dict(self) -> dict[str, Any]:
        return {"shift_mm": self.shift_mm.tolist(), "turn_deg": self.turn_deg.tolist()}

    def __str__(self) -> str:
        shift, turn = self.shift_mm, self.turn_deg
        return (
            f"poses of {len(shift)} training frames were corrected by {shift.mean():.2f} mm (at most {shift.max():.2f})"
            f" and {turn.mean():.2f}° (at most {turn.max():.2f}) on average"
        )
