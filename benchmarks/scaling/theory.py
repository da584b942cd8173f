"""Cases with known answers, for which the simulation must give the same."""

from __future__ import annotations

import math

from .workload import Floats


def waiting_share(load: float, processes: int) -> float:
    """Erlang's C: the share of those that wait at all in M/M/k. `load`: mean number of busy processes."""
    if not 0.0 <= load < processes:
        raise ValueError(f"load must be at least 0 and below the {processes} processes, got {load}")
    terms = [load**count / math.factorial(count) for count in range(processes)]
    last = load**processes / math.factorial(processes) * processes / (processes - load)
    return last / (sum(terms) + last)


def mean_wait(load: float, processes: int) -> float:
    """Mean wait in M/M/k, in mean times of service."""
    return waiting_share(load, processes) / (processes - load)


def wait_quantile(load: float, processes: int, share: float) -> float:
    """The wait in M/M/k that a share of all do not exceed, in mean times of service."""
    waiting = waiting_share(load, processes)
    return max(0.0, math.log(waiting / (1.0 - share)) / (processes - load))


def mean_wait_of_constant_work(load: float) -> float:
    """Mean wait in M/D/1, in times of service."""
    return load / (2.0 * (1.0 - load))


def ring_variation(replicas: int, points: int) -> float:
    """Coefficient of variation of the shares of a ring of `points` random points for each replica.

    The share of a replica is the sum of `points` of all the gaps, so that it has a beta distribution.
    """
    return math.sqrt((replicas - 1) / (replicas * points + 1))


def lru_hits(shares: Floats, slots: int) -> float:  # [scenes]
    """Che's approximation: the share of hits of a cache of `slots` scenes that are asked for independently."""
    low, high = 0.0, 1.0
    while -math.fsum(map(math.expm1, (-high * shares).tolist())) < slots:
        high *= 2.0
    for _ in range(80):
        middle = (low + high) / 2.0
        held = -math.fsum(map(math.expm1, (-middle * shares).tolist()))
        low, high = (middle, high) if held < slots else (low, middle)
    return -math.fsum((shares * [math.expm1(-low * share) for share in shares.tolist()]).tolist())
