"""The queue of a replica: first come, first served by its render processes.

A pose of a stream that comes while the one before it still waits takes its place, as in the mode `latest`; what would
wait longer than the patience is refused at once.
"""

from __future__ import annotations

import heapq
import math

import numpy as np

from .workload import Floats, Integers

ALONE = -1  # the stream of a single request


def begins(
    arrival_s: Floats,  # [N], ascending
    work_s: Floats,  # [N]
    stream: Integers,  # [N]
    *,
    patience_s: float = math.inf,
    processes: int = 1,
) -> Floats:  # [N]
    """The time at which the work on each begins; NaN for one that was replaced or refused."""
    begun: list[float] = []
    free = [0.0] * processes  # a heap: when each process has done what it was given
    latest: dict[int, int] = {}
    replace = heapq.heapreplace
    for index, (now, work, one) in enumerate(zip(arrival_s.tolist(), work_s.tolist(), stream.tolist(), strict=True)):
        before = latest.get(one) if one != ALONE else None
        if before is not None and begun[before] > now:
            begun.append(begun[before])
            begun[before] = math.nan
            latest[one] = index
            continue
        start = free[0] if free[0] > now else now
        if start - now > patience_s:
            begun.append(math.nan)
            continue
        replace(free, start + work)
        begun.append(start)
        if one != ALONE:
            latest[one] = index
    return np.array(begun)
