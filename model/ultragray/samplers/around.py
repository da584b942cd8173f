"""Random poses around a trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ultragray.contract import described, kind_field
from ultragray.probe import FloatArray, Probe
from ultragray.samplers.rotations import about_axes, random_directions
from ultragray.samplers.sampler import MAX_DRAWN, DrawnSampler, count_field, seed_field


@dataclass(frozen=True)
class AroundSampler(DrawnSampler):
    """`count` of the base poses, drawn at random with repetition, each turned and shifted at random.

    It turns about a random axis through the probe's origin by a normal angle of standard deviation `rotation_deg`, and
    shifts by a normal step of standard deviation `translation_mm` along each axis. Raises InvalidArgument.
    """

    count: int = count_field(high=MAX_DRAWN)
    translation_mm: float = described("Standard deviation along each axis.", 2.0, low=0.0, high=1000.0)
    rotation_deg: float = described("Standard deviation of the angle.", 5.0, low=0.0, high=180.0)
    seed: int = seed_field()
    kind: Literal["around"] = kind_field("around")

    def _drawn(self, base: FloatArray, probe: Probe) -> FloatArray:
        random = np.random.default_rng(self.seed)
        moved: FloatArray = base[random.integers(len(base), size=self.count)]
        axes = random_directions(random, self.count)
        angles = np.radians(random.normal(0.0, self.rotation_deg, self.count))
        moved[:, :3, :3] = moved[:, :3, :3] @ about_axes(axes, angles)
        moved[:, :3, 3] += random.normal(0.0, self.translation_mm, (self.count, 3))
        return moved
