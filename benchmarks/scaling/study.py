"""The runs that are made: what is compared in each study, and how one case is run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from . import balancers
from .balancers import Balancer, BoundedLoad, Hashed, Hashes, LeastRequest, Replicas
from .caches import CacheSizes
from .costs import SceneCosts, Storage
from .defaults import DEFAULTS
from .outcome import Outcome, Window, evaluate
from .routing import Change, Cluster, route
from .workload import GRPC, HTTP, Workload, draw_traffic

SETTLING_S = 60.0  # in which the caches fill
MEASURED_S = 6.0
HOT_SCENES = 10  # that have several keys, where any have


@dataclass(frozen=True)
class Policy:
    """How Envoy chooses. `factor` None: without a bound on the load."""

    name: str = "ring hash"  # or: random, least request, Maglev
    factor: int | None = DEFAULTS.hash_balance_factor
    ring_size: int = DEFAULTS.minimum_ring_size
    one_home: bool = DEFAULTS.one_home  # behind both doors
    keys: int = DEFAULTS.keys_of_hot_scene  # of each of the HOT_SCENES, so that they have as many homes
    weighted: bool = True  # by the speed of the replicas

    def balancer(self, replicas: Replicas, door: int, scenes: int, seed: int) -> Balancer:
        if self.name == "random":
            return balancers.Random(replicas, seed + door)
        if self.name == "least request":
            return LeastRequest(replicas, seed + door)
        hashes = Hashes(seed, 0 if self.one_home else door)
        if self.name == "ring hash":
            homes = balancers.ring_homes(replicas, hashes, scenes, self.keys, self.ring_size)
        elif self.name == "Maglev":
            homes = balancers.maglev_homes(replicas, hashes, scenes, self.keys)
        else:
            raise ValueError(f"policy must be random, least request, ring hash or Maglev, got {self.name!r}")
        homes[1:, HOT_SCENES:] = homes[0, HOT_SCENES:]
        hashed = Hashed(homes, seed + door)
        return hashed if self.factor is None else BoundedLoad(hashed, replicas, self.factor, seed)


@dataclass(frozen=True)
class Case:
    """One row of a table, run with several seeds."""

    policy: Policy = field(default_factory=Policy)
    workload: Workload = field(default_factory=Workload)
    replicas: int = 1000
    sizes: CacheSizes = field(default_factory=CacheSizes)
    storage: Storage = field(default_factory=Storage)
    proxies: int = 1
    speeds: tuple[float, ...] = (1.0,)  # of the replicas in turn
    changes: tuple[Change, ...] = ()
    measured_s: float = MEASURED_S


def run(case: Case, kinds: Sequence[SceneCosts], seed: int) -> Outcome:
    """One run: the same seed has the same clients in every case with the same workload."""
    clients, others = (np.random.default_rng((seed, part)) for part in range(2))
    window = Window(SETTLING_S, SETTLING_S + case.measured_s)
    traffic = draw_traffic(case.workload, window.end_s, case.proxies, clients)
    joining = [number for change in case.changes for number in change.join]
    speeds = [case.speeds[number % len(case.speeds)] for number in range(case.replicas + len(joining))]
    cluster = Cluster(
        replicas=case.replicas,
        speeds=speeds,
        sizes=case.sizes,
        storage=case.storage,
        proxies=case.proxies,
        balancers=partial(_balancers, case, speeds, seed),
        changes=case.changes,
    )
    routed = route(traffic, case.workload, kinds, cluster, others)
    dead = {number for change in case.changes for number in change.die}
    alive = [number for number in range(len(speeds)) if number not in dead]
    return evaluate(routed, traffic, case.workload, kinds, speeds, alive, window, others)


def _balancers(case: Case, speeds: Sequence[float], seed: int, alive: Sequence[int]) -> list[Balancer]:
    weights = np.array([speeds[number] if case.policy.weighted else 1.0 for number in alive])
    replicas = Replicas(alive, weights / weights.sum())
    return [case.policy.balancer(replicas, door, case.workload.scenes, seed) for door in (GRPC, HTTP)]
