"""Event by event: which replica each request and stream gets, and where it finds the scene.

Waiting in the queues of replicas is computed afterwards (queues.py). An Envoy counts a request as open for the time of
its fetch, its work, and the mean wait at a replica with so many streams (Pollaczek and Khinchine).
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from .balancers import Balancer, OpenRequests
from .caches import CacheSizes, ReplicaCache, Source
from .costs import SceneCosts, Storage
from .workload import Traffic, Workload

PATIENCE_S = 1.0  # the service refuses an interactive request that would wait longer (`max_queue_ms`)
RECONNECTED_S = (0.2, 1.5)  # after its replica died, a stream is asked for again between these times


@dataclass(frozen=True)
class Change:
    """Replicas that die, with their streams and caches, and others that join with empty caches."""

    time_s: float
    die: Sequence[int] = ()
    join: Sequence[int] = ()


@dataclass(frozen=True)
class Cluster:
    """The replicas at first, and what happens to them. `balancers` makes those of both doors for the living ones."""

    replicas: int
    speeds: Sequence[float]  # of every replica, those that join too; 1 as measured
    sizes: CacheSizes
    storage: Storage
    proxies: int
    balancers: Callable[[Sequence[int]], Sequence[Balancer]]  # [doors]
    changes: Sequence[Change] = ()


@dataclass
class Routed:
    """What reached the replicas. Of each asking [A]: a request, or a stream that opened, or opened again."""

    asked_s: list[float] = field(default_factory=list)
    ready_s: list[float] = field(default_factory=list)  # its scene is there, so that it joins the replica's queue
    end_s: list[float] = field(default_factory=list)  # of a stream, else 0
    replica: list[int] = field(default_factory=list)
    scene: list[int] = field(default_factory=list)
    source: list[int] = field(default_factory=list)


class _Event(IntEnum):
    REQUEST_DONE = 0
    STREAM_DONE = 1
    STREAM_AGAIN = 2
    CHANGE = 3


def route(
    traffic: Traffic, workload: Workload, kinds: Sequence[SceneCosts], cluster: Cluster, random: np.random.Generator
) -> Routed:
    """Sends all traffic to replicas. `kinds`: the costs of small and of large scenes."""
    return _Router(traffic, workload, kinds, cluster, random).run()


class _Router:
    def __init__(
        self,
        traffic: Traffic,
        workload: Workload,
        kinds: Sequence[SceneCosts],
        cluster: Cluster,
        random: np.random.Generator,
    ) -> None:
        self._events = list(zip(traffic.time_s.tolist(), traffic.length_s.tolist(), strict=True))
        self._scene: list[int] = traffic.scene.tolist()
        self._door: list[int] = traffic.door.tolist()
        self._proxy: list[int] = traffic.proxy.tolist()
        self._cluster = cluster
        self._random = random
        self._costs = [kinds[large] for large in traffic.large.tolist()]
        self._caches = [ReplicaCache(cluster.sizes, self._costs, cluster.storage) for _ in cluster.speeds]
        self._alive = list(range(cluster.replicas))
        self._is_alive = [number < cluster.replicas for number in range(len(cluster.speeds))]
        self._balancers = cluster.balancers(self._alive)
        # [proxies][doors]
        self._open = [[OpenRequests(len(cluster.speeds)) for _ in self._balancers] for _ in range(cluster.proxies)]
        self._streams: list[set[int]] = [set() for _ in cluster.speeds]  # indices of askings
        self._waits = [mean_waits(workload, kinds, speed) for speed in cluster.speeds]
        self._later: list[tuple[float, int, _Event, int]] = []  # a heap; its numbers keep the order of equal times
        self._number = itertools.count()
        self._routed = Routed()
        self._origin: list[int] = []  # of each asking, its index in the traffic
        self._until: dict[int, float] = {}  # of the askings of streams that lost their replica

    def run(self) -> Routed:
        for index, change in enumerate(self._cluster.changes):
            self._plan(change.time_s, _Event.CHANGE, index)
        later = self._later
        for index, (now_s, length_s) in enumerate(self._events):
            while later and later[0][0] <= now_s:
                self._happen(*heapq.heappop(later))
            self._ask(index, now_s, now_s + length_s if length_s else 0.0)
        return self._routed

    def _plan(self, time_s: float, event: _Event, index: int) -> None:
        heapq.heappush(self._later, (time_s, next(self._number), event, index))

    def _happen(self, now_s: float, _: int, event: _Event, index: int) -> None:
        if event is _Event.CHANGE:
            self._change(now_s, self._cluster.changes[index])
        elif event is _Event.STREAM_AGAIN:
            self._ask(self._origin[index], now_s, self._until[index])
        else:
            replica = self._routed.replica[index]
            if event is _Event.STREAM_DONE:
                self._streams[replica].discard(index)
            if self._is_alive[replica]:
                self._close(index, replica)

    def _ask(self, origin: int, now_s: float, end_s: float) -> None:
        """A request (`end_s` 0), or a stream until then."""
        routed = self._routed
        scene, door = self._scene[origin], self._door[origin]
        opened = self._open[self._proxy[origin]][door]
        replica = self._balancers[door].choose(scene, opened)
        source, ready_s = self._caches[replica].ask(scene, now_s)
        opened.of[replica] += 1
        opened.total += 1
        index = len(routed.asked_s)
        routed.asked_s.append(now_s)
        routed.ready_s.append(ready_s)
        routed.end_s.append(end_s)
        routed.replica.append(replica)
        routed.scene.append(scene)
        routed.source.append(source)
        self._origin.append(origin)
        if end_s:
            self._streams[replica].add(index)
            self._plan(end_s, _Event.STREAM_DONE, index)
        else:
            self._plan(ready_s + self._time_s(replica, scene, source), _Event.REQUEST_DONE, index)

    def _time_s(self, replica: int, scene: int, source: Source) -> float:
        waits, costs = self._waits[replica], self._costs[scene]
        wait_s = waits[min(len(self._streams[replica]), len(waits) - 1)]
        work_s = costs.frame_s + (costs.load_s if source is not Source.MEMORY else 0.0)
        return wait_s + work_s / self._cluster.speeds[replica] + costs.overhead_s

    def _close(self, index: int, replica: int) -> None:
        origin = self._origin[index]
        opened = self._open[self._proxy[origin]][self._door[origin]]
        opened.of[replica] -= 1
        opened.total -= 1

    def _change(self, now_s: float, change: Change) -> None:
        """The balancers know at once; the streams of dead replicas come again, one by one."""
        again: list[int] = []
        for replica in change.die:
            self._is_alive[replica] = False
            again += sorted(self._streams[replica])
            for doors in self._open:
                for opened in doors:
                    opened.total -= opened.of[replica]
                    opened.of[replica] = 0
        for replica in change.join:
            self._is_alive[replica] = True
        self._alive = sorted((set(self._alive) - set(change.die)) | set(change.join))
        self._balancers = self._cluster.balancers(self._alive)
        for index, after_s in zip(again, self._random.uniform(*RECONNECTED_S, len(again)).tolist(), strict=True):
            self._until[index], self._routed.end_s[index] = self._routed.end_s[index], now_s
            if now_s + after_s < self._until[index]:
                self._plan(now_s + after_s, _Event.STREAM_AGAIN, index)


def mean_waits(workload: Workload, kinds: Sequence[SceneCosts], speed: float) -> list[float]:
    """The mean wait [streams] at a replica with so many streams, up to the number that fills it: seconds."""
    shares = (1.0 - workload.large_share, workload.large_share)
    means = [kind.frame_s / speed for kind in kinds]
    mean = sum(share * one for share, one in zip(shares, means, strict=True))
    squared = sum(
        share * one**2 * math.exp(kind.spread**2) for share, one, kind in zip(shares, means, kinds, strict=True)
    )
    waits = []
    for streams in range(math.ceil(1.0 / (mean * workload.poses_per_s))):
        rate = streams * workload.poses_per_s
        waits.append(min(PATIENCE_S, rate * squared / (2.0 * (1.0 - rate * mean))))
    return [*waits, PATIENCE_S]
