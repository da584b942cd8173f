"""The base of all pose samplers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ultragray.contract import Family, described
from ultragray.errors import InvalidArgument
from ultragray.pose import check_poses
from ultragray.probe import FloatArray, Probe

MAX_POSES = 100_000  # that are made at once
MAX_DRAWN = 100_000_000  # of a batch that is made in shards: 20,000 files of 5,000 frames
BLOCK_POSES = 5_000  # drawn by one generator: a shard of as many frames draws its own poses and no others
MAX_SEED = 2**63 - 1


class Sampler(Family):
    """Makes poses from base poses: those that the caller gives, else the training poses of a scene."""

    __topic__ = "Sampling"
    kind: str

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


class DrawnSampler(Sampler):
    """Draws `count` poses at random, block by block, each block by a seed of its own that follows from `seed`.

    A pose depends on its number, the seed and, in the last block, the count: any part can be made without the rest.
    """

    count: int
    seed: int

    @property
    def block_count(self) -> int:
        """The number of blocks; all but the last have BLOCK_POSES poses."""
        return -(-self.count // BLOCK_POSES)

    def block(self, number: int) -> DrawnSampler:
        """The sampler of one block: itself where there is one block only."""
        count = min(BLOCK_POSES, self.count - number * BLOCK_POSES)
        return self.with_draws(count, self.seed if number == 0 else seed_of(self.seed, number, _BLOCKS))

    def with_draws(self, count: int, seed: int) -> DrawnSampler:
        """The same with another count and seed."""
        changes: Any = {"count": count, "seed": seed}
        return replace(self, **changes)  # type: ignore[type-var]  # its members are dataclasses

    def require_few(self) -> None:
        """Raises InvalidArgument where the poses are too many to be made at once."""
        if self.count > MAX_POSES:
            raise InvalidArgument(
                f"count {self.count:,} is more than the {MAX_POSES:,} poses that are made at once: more are rendered "
                "in shards, by a render job or by `ultragray render --on`",
                field="count",
            )

    def _made(self, base: FloatArray, probe: Probe) -> FloatArray:
        self.require_few()
        return np.concatenate([self.block(number)._drawn(base, probe) for number in range(self.block_count)])

    def _drawn(self, base: FloatArray, probe: Probe) -> FloatArray:  # [P, 4, 4] -> [C, 4, 4] mm
        """The poses of one block from at least one checked base pose, by the generator of `seed`."""
        raise NotImplementedError


_BLOCKS = 0x626C6F63  # keeps the seeds of blocks apart from those of the rounds of a search


def seed_of(seed: int, *numbers: int) -> int:
    """The seed of a numbered part of what a seed stands for."""
    return int(np.random.SeedSequence([seed, *numbers]).generate_state(1, np.uint64)[0] >> np.uint64(1))


def count_field(*default: Any, high: int = MAX_POSES) -> Any:
    """The field for the number of poses."""
    return described("How many poses.", *default, low=1, high=high)


def seed_field() -> Any:
    """The field for the seed of random choices."""
    return described("Of the random choices.", 0, low=0, high=MAX_SEED)
