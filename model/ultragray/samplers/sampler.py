"""The base of all pose samplers."""

from __future__ import annotations

from typing import Any, ClassVar

from ..contract import Family, described
from ..errors import InvalidArgument
from ..pose import check_poses
from ..probe import FloatArray, Probe

MAX_POSES = 100_000
MAX_SEED = 2**63 - 1


class Sampler(Family):
    """Makes poses from base poses: those that the caller gives, else the training poses of a scene."""

    __topic__ = "Sampling"
    kind: str
    draws: ClassVar[bool] = False
    """Whether it draws `count` poses by a `seed`, so that another seed gives others."""

    def poses(self, base: Any, probe: Probe) -> FloatArray:  # [P, 4, 4] -> [C, 4, 4] mm
        """The poses, exact; the same base, probe and sampler give the same.

        Raises InvalidPose, and InvalidArgument where the base has too few poses or more than 100,000 would come out.
        """
        checked = check_poses(base)
        if not len(checked):
            raise InvalidArgument(f"sampler {self.kind} needs base poses, got none", field="kind")
        return check_poses(self._made(checked, probe))

    def _made(self, base: FloatArray, probe: Probe) -> FloatArray:  # [P, 4, 4] -> [C, 4, 4] mm
        """The poses from at least one checked base pose."""
        raise NotImplementedError

    def _require_few(self, made: float, name: str) -> None:
        if made > MAX_POSES:
            raise InvalidArgument(
                f"{name} {getattr(self, name):g} gives more than the {MAX_POSES:,} poses that can be made", field=name
            )


def count_field(*default: Any) -> Any:
    """The field for the number of poses."""
    return described("How many poses.", *default, low=1, high=MAX_POSES)


def seed_field() -> Any:
    """The field for the seed of random choices."""
    return described("Of the random choices.", 0, low=0, high=MAX_SEED)
