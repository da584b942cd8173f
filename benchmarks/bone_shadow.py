"""The shadow of bone in the phantom, and the error of a rendering there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ultragray.errors import DatasetInvalid
from ultragray.learn.sweep import Sweep
from ultragray.phantom import bone_attenuation_db

Float32Array = npt.NDArray[np.float32]

SHADOW_DB = 30.0  # taken by bone, there and back


@dataclass(frozen=True, eq=False)
class BoneShadow:
    """The pixels of a sweep of the phantom from which bone takes more than SHADOW_DB."""

    sweep: Sweep
    hidden: npt.NDArray[np.bool_]  # [F, H, W]

    @classmethod
    def of(cls, sweep: Sweep) -> BoneShadow:
        """Simulates the attenuation along each scan line.

        Raises DatasetInvalid for a sweep of a probe that the phantom is not scanned with, or without a pixel behind
        bone.
        """
        if not sweep.probe.is_true_to_scale:
            raise DatasetInvalid(f"{sweep.source}: the phantom is scanned along upright lines, got {sweep.probe}")
        attenuation_db = bone_attenuation_db(sweep.poses, probe=sweep.probe, height=sweep.height, width=sweep.width)
        hidden = attenuation_db > SHADOW_DB
        if not hidden.any():
            raise DatasetInvalid(f"{sweep.source}: no pixel lies in the shadow of bone")
        return cls(sweep, hidden)

    def mean(self, values: Float32Array) -> float:  # [F, H, W]
        """Mean of something over the shadow."""
        return float(values[self.hidden].mean(dtype=np.float64))

    def mean_absolute_error(self, frames: Float32Array) -> float:  # [F, H, W] in [0, 1]
        """Mean absolute difference between predicted frames and those of the sweep over the shadow."""
        return self.mean(np.abs(frames - self.sweep.images / np.float32(255.0)))
