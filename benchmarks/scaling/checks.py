"""The parts of the simulation where the answer is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from . import theory
from .balancers import Hashes, Replicas, ring_homes
from .caches import CacheSizes, ReplicaCache, Source
from .costs import SceneCosts, Storage
from .queues import ALONE, begins
from .workload import Floats, Workload, popularity

ARRIVALS = 200_000
SCENES = 200_000  # whose homes measure the shares of a ring
SLOTS = 100  # scenes of a cache

Check = tuple[float, Callable[[np.random.Generator], float]]  # the known answer, and the simulation's


def waits(load: float, processes: int, work_s: Floats, random: np.random.Generator) -> Floats:  # [N]
    """The waits of Poisson arrivals, so many that `load` processes are busy on average; mean work is 1 s."""
    arrival_s = np.cumsum(random.exponential(1.0 / load, len(work_s)))
    stream = np.full(len(work_s), ALONE)
    return begins(arrival_s, work_s, stream, processes=processes) - arrival_s


def mean_wait(load: float, processes: int, random: np.random.Generator) -> float:
    return float(waits(load, processes, random.exponential(1.0, ARRIVALS), random).mean())


def wait_quantile(load: float, processes: int, share: float, random: np.random.Generator) -> float:
    return float(np.quantile(waits(load, processes, random.exponential(1.0, ARRIVALS), random), share))


def ring_variation(replicas: int, minimum_size: int, random: np.random.Generator) -> float:
    """Of the numbers of scenes at home with each replica."""
    hashes = Hashes(int(random.integers(2**31)))
    homes = ring_homes(Replicas.equal(range(replicas)), hashes, SCENES, 1, minimum_size)
    counts = np.bincount(homes[0], minlength=replicas)
    return float(counts.std() / counts.mean())


def lru_hits(random: np.random.Generator) -> float:
    """Of a replica that is asked for 10,000 scenes of the same size, Zipf's with the exponent 1."""
    scenes = Workload.scenes
    same = SceneCosts(gaussians=1, file_bytes=1, resident_bytes=1, load_s=0.0, frame_s=1.0, overhead_s=0.0, spread=0.0)
    cache = ReplicaCache(CacheSizes(memory=SLOTS, folder=1), [same] * scenes, Storage())
    asked = random.choice(scenes, ARRIVALS // 2, p=popularity(Workload()))
    sources = np.array([cache.ask(scene, 0.0)[0] for scene in asked.tolist()])
    return float((sources[len(sources) // 4 :] == Source.MEMORY).mean())


def _of_scenes(replicas: int, points: int) -> float:
    """With the variation of the number of scenes beside that of the shares."""
    return math.hypot(theory.ring_variation(replicas, points), math.sqrt(replicas / SCENES))


CHECKS: Mapping[str, Check] = {
    "mean wait in M/M/1 at 80%, in times of service": (
        theory.mean_wait(0.8, 1),
        lambda random: mean_wait(0.8, 1, random),
    ),
    "mean wait in M/M/4 at 80%": (theory.mean_wait(3.2, 4), lambda random: mean_wait(3.2, 4, random)),
    "99% of waits in M/M/4 at 80% are below": (
        theory.wait_quantile(3.2, 4, 0.99),
        lambda random: wait_quantile(3.2, 4, 0.99, random),
    ),
    "mean wait in M/D/1 at 80%": (
        theory.mean_wait_of_constant_work(0.8),
        lambda random: float(waits(0.8, 1, np.ones(ARRIVALS), random).mean()),
    ),
    "variation of 1,000 replicas on a ring with 2 points each": (
        _of_scenes(1000, 2),
        lambda random: ring_variation(1000, 1024, random),
    ),
    "variation of 1,000 replicas on a ring with 66 points each": (
        _of_scenes(1000, 66),
        lambda random: ring_variation(1000, 65_536, random),
    ),
    "hits of a cache of 100 of 10,000 scenes": (theory.lru_hits(popularity(Workload()), SLOTS), lru_hits),
}


def run(seed: int) -> dict[str, float]:
    """What the simulation answers."""
    found = {}
    for index, (name, (_, simulate)) in enumerate(CHECKS.items()):
        found[name] = simulate(np.random.default_rng((seed, index)))
    return found
