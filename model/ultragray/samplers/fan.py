"""Tilted sweeps, as the paper records them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..probe import FloatArray, LinearProbe, Probe
from .rotations import about_axes
from .sampler import Sampler, is_number

MAX_TILT_DEG = 90.0  # the beam lies along the skin then


@dataclass(frozen=True)
class FanSampler(Sampler):
    """The base poses, tilted by every multiple of `step_deg` from −`tilt_deg` to +`tilt_deg`: one sweep a tilt.

    The probe turns about its lateral axis x through the middle of its face, which stays where it is (linear: the
    origin; otherwise `near_mm` along the axial axis). A positive tilt turns the beam towards −y, as
    `freehand_poses(tilt_deg=…)` of the phantom does. Raises InvalidArgument.
    """

    tilt_deg: float
    step_deg: float

    kind: ClassVar[str] = "fan"

    def __post_init__(self) -> None:
        self._require(is_number(self.tilt_deg, 0.0, MAX_TILT_DEG), "tilt_deg", f"from 0 to {MAX_TILT_DEG:g}")
        self._require(
            is_number(self.step_deg, 0.0, MAX_TILT_DEG) and self.step_deg > 0.0,
            "step_deg",
            f"above 0, at most {MAX_TILT_DEG:g}",
        )

    def _made(self, base: FloatArray, probe: Probe) -> FloatArray:
        steps = math.floor(min(self.tilt_deg / self.step_deg, 1e9) + 1e-9)
        tilts = 2 * steps + 1
        self._require_few(float(tilts) * len(base), "step_deg")
        angles = np.radians(self.step_deg * np.arange(-steps, steps + 1))
        turns = about_axes(np.tile([1.0, 0.0, 0.0], (tilts, 1)), angles)
        fan = np.tile(base, (tilts, 1, 1, 1))  # [tilts, P, 4, 4]
        fan[..., :3, :3] = base[:, :3, :3] @ turns[:, None]
        axial = base[:, :3, 2] - fan[..., :3, 2]
        fan[..., :3, 3] += face_depth_mm(probe) * axial
        return fan.reshape(-1, 4, 4)


def face_depth_mm(probe: Probe) -> float:
    """Where the middle of the face lies on the axial axis: a linear probe's frame begins there, a fan's at its apex."""
    return 0.0 if isinstance(probe, LinearProbe) else probe.near_mm
