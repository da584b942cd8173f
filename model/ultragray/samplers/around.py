"""Random poses around a trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..probe import FloatArray, Probe
from .rotations import about_axes, random_directions
from .sampler import MAX_ROTATION_DEG, MAX_TRANSLATION_MM, Sampler, is_number


@dataclass(frozen=True)
class AroundSampler(Sampler):
    """`count` of the base poses, drawn at random with repetition, each turned and shifted at random.

    It turns about a random axis through the probe's origin by a normal angle of standard deviation `rotation_deg`, and
    shifts by a normal step of standard deviation `translation_mm` along each axis. Raises InvalidArgument.
    """

    count: int
    translation_mm: float = 2.0
    rotation_deg: float = 5.0
    seed: int = 0

    kind: ClassVar[str] = "around"

    def __post_init__(self) -> None:
        self._require_count()
        for name, limit in (("translation_mm", MAX_TRANSLATION_MM), ("rotation_deg", MAX_ROTATION_DEG)):
            self._require(is_number(getattr(self, name), 0.0, limit), name, f"between 0 and {limit:g}")
        self._require_seed()

    def _made(self, base: FloatArray, probe: Probe) -> FloatArray:
        random = np.random.default_rng(self.seed)
        moved: FloatArray = base[random.integers(len(base), size=self.count)]
        axes = random_directions(random, self.count)
        angles = np.radians(random.normal(0.0, self.rotation_deg, self.count))
        moved[:, :3, :3] = moved[:, :3, :3] @ about_axes(axes, angles)
        moved[:, :3, 3] += random.normal(0.0, self.translation_mm, (self.count, 3))
        return moved
