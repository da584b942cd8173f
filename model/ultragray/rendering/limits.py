"""Limits of a rendering: the cost of a frame, and a flag by which another thread or process ends it.

The cost of a frame is told in footprint pixels: the image plane cuts a scene's Gaussians, each leaves a footprint of
pixels there, and their sum, with what is slow to draw counted as more, is what the time of the frame follows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from ultragray.errors import FrameTooCostly

Flag = npt.NDArray[np.int64]  # [1], in memory that the one who ends a rendering shares with the one who renders


class GivenUp(Exception):
    """The flag of a rendering was raised before its frames were ready."""


@dataclass(frozen=True, eq=False)
class Limits:
    """What a rendering is bound by. Its flag is raised once it holds at least `number`: numbers rise from rendering to
    rendering, so that what ends one never ends a later one.
    """

    footprint_pixels: int | None = None  # of each frame
    flag: Flag | None = None
    number: int = 0
    name_pose: Callable[[int], str] = field(default="poses[{}]".format, repr=False)  # as whoever asked for it names it

    def after(self, poses: int) -> Limits:
        """The same for poses of which so many come before."""
        return replace(self, name_pose=lambda pose: self.name_pose(poses + pose))

    def check_flag(self) -> None:
        if self.flag is not None and self.flag[0] >= self.number:
            raise GivenUp

    def check_costs(self, footprint_pixels: Iterable[int], first: int = 0) -> None:
        """Raises FrameTooCostly for the first pose of too high a cost; `first` is the number that they begin with."""
        if self.footprint_pixels is not None:
            for pose, cost in enumerate(footprint_pixels, first):
                if cost > self.footprint_pixels:
                    raise self.too_costly(pose, cost)

    def too_costly(self, pose: int, footprint_pixels: int) -> FrameTooCostly:
        """The error of a pose whose frame has a cost above the limit."""
        assert self.footprint_pixels is not None
        return FrameTooCostly(
            f"a frame may cost {_millions(self.footprint_pixels)} footprint pixels, this one would about "
            f"{_millions(footprint_pixels)}: the Gaussians are too wide for its size; ask for fewer pixels",
            field=self.name_pose(pose),
        )


UNLIMITED = Limits()


def _millions(count: int) -> str:
    return f"{count / 1e6:,.0f} million"
