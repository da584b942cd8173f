"""How far corrections moved the frames of a scene. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ultragray.geometry.probe import FloatArray
from ultragray.geometry.rotations import turn_angles_rad


@dataclass(frozen=True, eq=False)
class CorrectionSizes:
    """Of each training frame: the shift of the probe's origin and the turn of the probe."""

    shift_mm: FloatArray  # [P]
    turn_deg: FloatArray  # [P]

    @classmethod
    def of(cls, corrections: FloatArray, training_poses: FloatArray) -> CorrectionSizes:  # [P, 4, 4] both
        """Of corrections that were left-multiplied to the tracker's poses, which gave the training poses."""
        given = np.linalg.inv(corrections) @ training_poses
        shifts = np.linalg.norm(training_poses[:, :3, 3] - given[:, :3, 3], axis=1)
        return cls(shifts, np.degrees(turn_angles_rad(corrections[:, :3, :3], np.eye(3))))

    def to_dict(self) -> dict[str, Any]:
        return {"shift_mm": self.shift_mm.tolist(), "turn_deg": self.turn_deg.tolist()}

    def __str__(self) -> str:
        shift, turn = self.shift_mm, self.turn_deg
        return (
            f"poses of {len(shift)} training frames were corrected by {shift.mean():.2f} mm (at most {shift.max():.2f})"
            f" and {turn.mean():.2f}° (at most {turn.max():.2f}) on average"
        )
