"""Samplers that keep to poses whose frames can be trusted."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from ultragray.errors import InvalidArgument, LowConfidence
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.samplers.sampler import BLOCK_POSES, DrawnSampler, Sampler, seed_of
from ultragray.scene.confidence import Extrapolation, is_confident, require_confidence

MOST_DRAWS_PER_POSE, LEAST_DRAWS = 20, 1000  # where so many do not suffice, the search is given up
SMALLEST_ROUND = 64
SPARE = 1.2  # of the draws that the share found so far lets expect

Assess: TypeAlias = Callable[[FloatArray], Sequence[Extrapolation]]  # [C, 4, 4] mm -> [C]


def assessed_poses(
    sampler: Sampler | None, base: Any, probe: Probe, assess: Assess, min_confidence: float | None
) -> tuple[FloatArray, Sequence[Extrapolation]]:  # base [P, 4, 4] -> [C, 4, 4] mm, [C]
    """The poses of a sampler, or without one `base` itself, and what `assess` finds about each.

    A sampler keeps to poses with `min_confidence` (None: any). Raises LowConfidence for a pose of `base` below it, and
    what `confident_poses` raises.
    """
    if sampler is not None and min_confidence is not None:
        return confident_poses(sampler, base, probe, assess, min_confidence)
    poses = check_poses(base) if sampler is None else sampler.poses(base, probe)
    extrapolations = assess(poses)
    require_confidence(extrapolations, min_confidence)
    return poses, extrapolations


def confident_poses(
    sampler: Sampler, base: Any, probe: Probe, assess: Assess, min_confidence: float
) -> tuple[FloatArray, list[Extrapolation]]:  # base [P, 4, 4] -> [C, 4, 4] mm, [C]
    """Those poses of a sampler that have at least `min_confidence`, and what `assess` finds about each.

    A random sampler draws on until it has the `count` of each of its blocks, at most 20 poses for each of them (at
    least 1000): the same arguments give the same poses, and where all of its first poses will do, they are these. The
    others leave out what does not have it. `assess` is an Assessor's, with the probe of the frames. Raises
    LowConfidence where no pose is left, or too few are found, and what `sampler.poses` raises.
    """
    if isinstance(sampler, DrawnSampler):
        sampler.require_few()
        return _of_blocks(sampler, base, probe, assess, min_confidence, range(sampler.block_count))
    poses = sampler.poses(base, probe)
    extrapolations = list(assess(poses))
    kept = [place for place, one in enumerate(extrapolations) if is_confident(one, min_confidence)]
    if not kept:
        best = max(one.confidence or 0.0 for one in extrapolations)
        raise LowConfidence(
            f"sampler {sampler.kind} makes {len(poses):,} poses, none with a confidence of at least "
            f"{min_confidence:g}: the best has {best:.2f}",
            field="sampler",
        )
    return poses[kept], [extrapolations[place] for place in kept]


def assessed_part(
    sampler: Sampler | None,
    base: Any,  # [P, 4, 4] mm
    probe: Probe,
    assess: Assess,
    min_confidence: float | None,
    first: int,
    last: int,
) -> tuple[FloatArray, Sequence[Extrapolation]]:  # [C, 4, 4] mm, [C]
    """Those of `assessed_poses` from number `first` to before `last`, without making many others.

    Raises InvalidArgument for a sampler that leaves poses out, whose poses have no numbers before all are made, and
    what `assessed_poses` raises.
    """
    if isinstance(sampler, DrawnSampler):
        blocks = range(first // BLOCK_POSES, -(-last // BLOCK_POSES))
        block_poses, assessments = _of_blocks(sampler, base, probe, assess, min_confidence, blocks)
        places = slice(first - blocks.start * BLOCK_POSES, last - blocks.start * BLOCK_POSES)
        return block_poses[places], assessments[places]
    if sampler is not None and min_confidence is not None:
        require_drawn(sampler)
    poses = (check_poses(base) if sampler is None else sampler.poses(base, probe))[first:last]
    extrapolations = assess(poses)
    require_confidence(extrapolations, min_confidence, first=first)
    return poses, extrapolations


def require_drawn(sampler: Sampler) -> None:
    """Raises InvalidArgument for a sampler that leaves out poses without a least confidence: in shards, none can."""
    if not isinstance(sampler, DrawnSampler):
        raise InvalidArgument(
            f"min_confidence in shards needs a sampler that draws (around, covered), got {sampler.kind}, which leaves "
            "poses out: mask such frames, or render them into one file",
            field="min_confidence",
        )


def _of_blocks(
    sampler: DrawnSampler, base: Any, probe: Probe, assess: Assess, min_confidence: float | None, blocks: range
) -> tuple[FloatArray, list[Extrapolation]]:
    poses: list[FloatArray] = []
    extrapolations: list[Extrapolation] = []
    for number in blocks:
        block = sampler.block(number)
        if min_confidence is None:
            block_poses = block.poses(base, probe)
            assessments = assess(block_poses)
        else:
            block_poses, assessments = _drawn_on(block, base, probe, assess, min_confidence)
        poses.append(block_poses)
        extrapolations.extend(assessments)
    return np.concatenate(poses), extrapolations


def _drawn_on(
    sampler: DrawnSampler, base: Any, probe: Probe, assess: Assess, min_confidence: float
) -> tuple[FloatArray, list[Extrapolation]]:
    count, most = sampler.count, max(LEAST_DRAWS, MOST_DRAWS_PER_POSE * sampler.count)
    poses: list[FloatArray] = []
    extrapolations: list[Extrapolation] = []
    drawn, rounds, draw = 0, 0, sampler
    while True:
        candidates = draw.poses(base, probe)
        for pose, extrapolation in zip(candidates, assess(candidates), strict=True):
            if is_confident(extrapolation, min_confidence):
                poses.append(pose)
                extrapolations.append(extrapolation)
        drawn, rounds, hits = drawn + len(candidates), rounds + 1, len(poses)
        if hits >= count:
            return np.stack(poses[:count]), extrapolations[:count]
        if drawn >= most:
            raise LowConfidence(
                f"sampler {sampler.kind} found {hits:,} of {count:,} poses with a confidence of at least "
                f"{min_confidence:g}: {hits / drawn:.2%} of {drawn:,} drawn have it",
                field="sampler",
            )
        wanted = math.ceil(SPARE * (count - hits) * drawn / max(hits, 1))
        size = min(max(wanted, SMALLEST_ROUND), max(count, SMALLEST_ROUND), most - drawn)
        draw = sampler.with_draws(size, seed_of(sampler.seed, rounds))
