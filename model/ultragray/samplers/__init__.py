"""Many poses made from few: pose samplers, as `ultragray render`, render jobs and scripts name them. Free of torch.

A sampler is made of numbers, travels as a JSON object with a `kind`, and makes the same poses wherever it is asked:
`from_dict(Sampler, {"kind": "fan", "tilt_deg": 10, "step_deg": 5}).poses(base, probe)` (`ultragray.contract`).
"""

from __future__ import annotations

from ultragray.samplers.confident import Assess, assessed_poses, confident_poses
from ultragray.samplers.sampler import (
    MAX_POSES,
    AroundSampler,
    CoveredSampler,
    DrawnSampler,
    FanSampler,
    Sampler,
    SplineSampler,
    TrainingSampler,
)

__all__ = [
    "MAX_POSES",
    "AroundSampler",
    "Assess",
    "CoveredSampler",
    "DrawnSampler",
    "FanSampler",
    "Sampler",
    "SplineSampler",
    "TrainingSampler",
    "assessed_poses",
    "confident_poses",
]
