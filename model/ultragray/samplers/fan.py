"""Tilted sweeps, as the paper records them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ultragray.contract import described, kind_field
from ultragray.probe import FloatArray, Probe
from ultragray.samplers.rotations import about_axes
from ultragray.samplers.sampler import Sampler

MAX_TILT_DEG = 90.0  # the beam lies along the skin then


@dataclass(frozen=True)
class FanSampler(Sampler):
    """The base poses, tilted by every multiple of `step_deg` from −`tilt_deg` to +`tilt_deg`: one sweep a tilt.

    The probe turns about its lateral axis x through the middle of its face, which stays where it is (linear: the
    origin; otherwise `near_mm` along the axial axis). A positive tilt turns the beam towards −y, as
    `freehand_poses(tilt_deg=…)` of the phantom does. Raises InvalidArgument.
    """

    tilt_deg: float = described("The largest tilt, to both sides.", low=0.0, high=MAX_TILT_DEG)
    step_deg: float = described("Between two tilts.", above=0.0, high=MAX_TILT_DEG)
    kind: Literal["fan"] = kind_field("fan")

    def _made(self, base: FloatArray, probe: Probe) -> FloatArray:
        steps = math.floor(min(self.tilt_deg / self.step_deg, 1e9) + 1e-9)
        tilts = 2 * steps + 1
        self._require_few(float(tilts) * len(base), "step_deg")
        angles = np.radians(self.step_deg * np.arange(-steps, steps + 1))
        turns = about_axes(np.tile([1.0, 0.0, 0.0], (tilts, 1)), angles)
        fan = np.tile(base, (tilts, 1, 1, 1))  # [tilts, P, 4, 4]
        fan[..., :3, :3] = base[:, :3, :3] @ turns[:, None]
        axial = base[:, :3, 2] - fan[..., :3, 2]
        fan[..., :3, 3] += probe.pivot_depth_mm * axial
        return fan.reshape(-1, 4, 4)
