"""A simulation of many replicas behind Envoy: who gets which request, what is cached where, how long frames wait.

The flow, and the order of this module: a `Workload` is drawn as `Traffic`; a `Router` sends it, event by event, to
replicas that a `Policy` chooses as Envoy does, each with a `ReplicaCache`; `begins` is the queue of a replica, pose by
pose; an `Outcome` is one run in figures. `STUDIES` has the cases that docs/scaling.md shows, and `DECIDED` what follows
from them: the values that Envoy's configuration and the chart take. `python benchmarks/simulation.py` runs it.

What Envoy counts as load are open requests: a stream is one. Hashes are random numbers here, drawn from the number of
the replica or the scene: what a good hash gives. HTTP and gRPC are doors with ports, and so clusters, of their own:
each counts its own open requests, and a scene has one home behind each.
"""

from __future__ import annotations

import heapq
import itertools
import math
import random
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from functools import partial
from typing import Protocol

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

GRPC, HTTP = 0, 1  # doors
PATIENCE_S = 1.0  # the service refuses an interactive request that would wait longer (`max_queue_ms`)
RECONNECTED_S = (0.2, 1.5)  # after its replica died, a stream is asked for again between these times
MAX_SCENES = 256  # that a render process keeps loaded, see ultragray_workers.pool.worker
SETTLING_S, MEASURED_S = 60.0, 6.0  # in which the caches fill; in which figures are taken
ALONE = -1  # the stream of a single request


@dataclass(frozen=True)
class Decided:
    """The values that Envoy's configuration and the chart take. docs/scaling.md has the figures that speak for each."""

    hash_balance_factor: int = 110  # per cent of the mean that one replica may have of open requests and streams
    minimum_ring_size: int = 65_536  # points of the ring: 66 for each of 1,000 replicas
    memory_budget_mb: int = 4096  # of loaded scenes, the service's own default
    utilisation: float = 0.5  # share of its time that a replica works; more replicas are wanted above
    queue_p95_ms: float = 12.0  # 95% of frames wait less; more replicas are wanted above


DECIDED = Decided()


@dataclass(frozen=True)
class SceneCosts:
    """What one scene costs a replica of two cores whose one render process has both."""

    gaussians: int
    file_bytes: int
    resident_bytes: int
    load_s: float  # processor time on one thread of the render process, in which it renders nothing else
    frame_s: float  # mean time of a frame of a gRPC stream that is kept busy
    overhead_s: float  # of the door, in which other frames are rendered
    spread: float  # standard deviation of the logarithm of a frame's time


@dataclass(frozen=True)
class Storage:
    """Assumed, not measured: a fetch from object storage in the same region."""

    first_byte_s: float = 0.03
    bytes_per_s: float = 100e6

    def fetch_s(self, size: int) -> float:
        """Time until an object of `size` bytes is here."""
        return self.first_byte_s + size / self.bytes_per_s


@dataclass(frozen=True)
class Workload:
    """Control loops that keep a stream open, and other clients that ask for a frame now and then.

    `exponent` is Zipf's: the r-th scene is asked for r^-exponent as often as the first.
    """

    scenes: int = 10_000
    exponent: float = 1.0
    clients: int = 100_000
    streaming_share: float = 0.05  # of the clients at any time
    websocket_share: float = 0.5  # of the streams; the others are gRPC's
    stream_s: float = 120.0  # mean time that a stream is open
    poses_per_s: float = 30.0  # of a stream
    request_every_s: float = 20.0  # mean, of a client without a stream
    large_share: float = 0.2  # of the scenes; the others are small

    @property
    def streams(self) -> int:
        """Streams that are open at any time."""
        return round(self.clients * self.streaming_share)

    @property
    def requests_per_s(self) -> float:
        """Single frames of all clients."""
        return (self.clients - self.streams) / self.request_every_s

    def popularity(self) -> Floats:  # [scenes]
        """The share of each scene in all that is asked for."""
        weights = np.arange(1, self.scenes + 1, dtype=np.float64) ** -self.exponent
        return np.asarray(weights / weights.sum())


@dataclass(frozen=True)
class Traffic:
    """All that is asked for, in order of time. A single request has a length of 0."""

    time_s: Floats  # [N]
    scene: Integers  # [N], 0 for the most popular
    length_s: Floats  # [N]
    door: Integers  # [N]
    large: npt.NDArray[np.bool_]  # [scenes]


def draw_traffic(workload: Workload, horizon_s: float, generator: np.random.Generator) -> Traffic:
    """The traffic of `horizon_s` seconds. At 0 as many streams open as are open at any time."""
    openings = generator.poisson(workload.streams / workload.stream_s * horizon_s)
    requests = generator.poisson(workload.requests_per_s * horizon_s)
    streams = workload.streams + openings
    count = streams + requests
    time_s = np.concatenate([np.zeros(workload.streams), generator.uniform(0.0, horizon_s, openings + requests)])
    length_s = np.concatenate([generator.exponential(workload.stream_s, streams), np.zeros(requests)])
    by_grpc = np.concatenate([generator.random(streams) >= workload.websocket_share, np.zeros(requests, np.bool_)])
    order = np.argsort(time_s, kind="stable")
    return Traffic(
        time_s=time_s[order],
        scene=generator.choice(workload.scenes, count, p=workload.popularity()),
        length_s=length_s[order],
        door=np.where(by_grpc, GRPC, HTTP)[order],
        large=generator.random(workload.scenes) < workload.large_share,
    )


class OpenRequests:
    """What Envoy has open at the replicas of one cluster."""

    def __init__(self, replicas: int) -> None:
        self.of: list[int] = [0] * replicas
        self.total = 0


class Balancer(Protocol):
    """One cluster of Envoy."""

    def choose(self, scene: int, open_requests: OpenRequests) -> int:
        """The number of the replica."""


class Random:
    """Any replica."""

    def __init__(self, numbers: Sequence[int], seed: int) -> None:
        self._numbers = list(numbers)
        self._random = random.Random(seed)

    def choose(self, scene: int, open_requests: OpenRequests) -> int:
        return self._numbers[int(self._random.random() * len(self._numbers))]


class LeastRequest(Random):
    """Of two random replicas the one with fewer open requests: Envoy's `least_request` with its defaults."""

    def choose(self, scene: int, open_requests: OpenRequests) -> int:
        one, other = (super(LeastRequest, self).choose(scene, open_requests) for _ in range(2))
        return other if open_requests.of[other] < open_requests.of[one] else one


class Ring:
    """The home of a scene on Envoy's `ring_hash`: the owner of the first point of the ring after the scene's hash."""

    def __init__(self, numbers: Sequence[int], scenes: int, minimum_size: int, seed: int, door: int = 0) -> None:
        points_each = math.ceil(minimum_size / len(numbers))
        points = np.concatenate([np.random.default_rng((seed, 1, door, one)).random(points_each) for one in numbers])
        order = np.argsort(points)
        owners = np.repeat(np.asarray(numbers), points_each)[order]
        hashes = np.random.default_rng((seed, 0)).random(scenes)
        self.homes = np.asarray(owners[np.searchsorted(points[order], hashes) % len(owners)])  # [scenes]
        self._homes: list[int] = self.homes.tolist()

    def choose(self, scene: int, open_requests: OpenRequests) -> int:
        return self._homes[scene]


class BoundedLoad:
    """The home of a scene, unless it has more open requests than its share, which is `factor` per cent of the mean.

    Then it is the first replica below its share in an order that depends on the scene alone. Envoy does not take the
    next on the ring: it shuffles all replicas by the hash of the key, so that the scenes of a full replica spread over
    all others. Each draw of the shuffle is scaled to the number of replicas, so that the order changes in part where
    one joins or leaves.
    """

    def __init__(self, homes: Balancer, numbers: Sequence[int], factor: int, seed: int) -> None:
        if factor <= 100:
            raise ValueError(f"factor must be above 100 per cent, got {factor}")
        self._home_of, self._factor, self._seed = homes, factor, seed
        self._numbers = list(numbers)
        self._orders: dict[int, tuple[list[int], random.Random, list[int]]] = {}  # by scene: drawn, source, the rest

    def choose(self, scene: int, open_requests: OpenRequests) -> int:
        opened, slots = open_requests.of, ((open_requests.total + 1) * self._factor + 99) // 100
        share = max(1, math.ceil(slots / len(self._numbers)))
        home = self._home_of.choose(scene, open_requests)
        if opened[home] <= share:
            return home
        if scene not in self._orders:
            self._orders[scene] = [], random.Random(self._seed * 2**32 + scene), list(self._numbers)
        drawn, source, rest = self._orders[scene]
        for replica in drawn:
            if opened[replica] <= share:
                return replica
        while True:  # ends: all shares together are more than all open requests
            place = int(source.random() * len(rest))
            rest[place], rest[-1] = rest[-1], rest[place]
            drawn.append(rest.pop())
            if opened[drawn[-1]] <= share:
                return drawn[-1]


class Source(IntEnum):
    """Where a replica found a scene."""

    MEMORY = 0
    FOLDER = 1  # fetched before, loaded now
    STORAGE = 2  # fetched and loaded now


@dataclass(frozen=True)
class CacheSizes:
    """Bytes of a replica; the memory is that of its one render process."""

    memory: int = DECIDED.memory_budget_mb * 2**20
    folder: int = 20 * 2**30


class _Recent:
    """Things within a budget of bytes, of which those least recently used give way; the newest always stays."""

    def __init__(self, budget: int, most: float = math.inf) -> None:
        self._budget, self._most, self._bytes = budget, most, 0
        self._kept: OrderedDict[int, tuple[int, float]] = OrderedDict()  # size, and the time from which it is there

    def find(self, scene: int) -> float | None:
        """The time from which the scene is there; None where it is not kept."""
        if scene not in self._kept:
            return None
        self._kept.move_to_end(scene)
        return self._kept[scene][1]

    def keep(self, scene: int, size: int, ready_s: float) -> None:
        self._kept[scene] = size, ready_s
        self._bytes += size
        while len(self._kept) > 1 and (self._bytes > self._budget or len(self._kept) > self._most):
            self._bytes -= self._kept.popitem(last=False)[1][0]


class ReplicaCache:
    """The scenes of one replica: loaded ones in memory, files in a bounded folder. `costs` has those of each scene."""

    def __init__(self, sizes: CacheSizes, costs: Sequence[SceneCosts], storage: Storage) -> None:
        self._costs, self._storage = costs, storage
        self._loaded, self._files = _Recent(sizes.memory, MAX_SCENES), _Recent(sizes.folder)

    def ask(self, scene: int, now_s: float) -> tuple[Source, float]:
        """Where the scene is, and the time from which the render process can work on it."""
        if (ready_s := self._loaded.find(scene)) is not None:
            return Source.MEMORY, max(ready_s, now_s)
        costs, source, ready_s = self._costs[scene], Source.FOLDER, now_s
        if self._files.find(scene) is None:
            source, ready_s = Source.STORAGE, now_s + self._storage.fetch_s(costs.file_bytes)
            self._files.keep(scene, costs.file_bytes, ready_s)
        self._loaded.keep(scene, costs.resident_bytes, ready_s)
        return source, ready_s


@dataclass(frozen=True)
class Policy:
    """How Envoy chooses. `factor` None: without a bound on the load."""

    name: str = "ring hash"  # or: random, least request
    factor: int | None = DECIDED.hash_balance_factor
    ring_size: int = DECIDED.minimum_ring_size

    def balancer(self, numbers: Sequence[int], door: int, scenes: int, seed: int) -> Balancer:
        """The cluster of a door; `numbers`: the replicas that are alive."""
        if self.name != "ring hash":
            return {"random": Random, "least request": LeastRequest}[self.name](numbers, seed + door)
        ring = Ring(numbers, scenes, self.ring_size, seed, door)
        return ring if self.factor is None else BoundedLoad(ring, numbers, self.factor, seed)


@dataclass(frozen=True)
class Change:
    """Replicas that die, with their streams and caches, and others that join with empty caches."""

    time_s: float
    die: Sequence[int] = ()
    join: Sequence[int] = ()


@dataclass(frozen=True)
class Case:
    """One row of a table, run with several seeds."""

    policy: Policy = field(default_factory=Policy)
    workload: Workload = field(default_factory=Workload)
    replicas: int = 1000
    sizes: CacheSizes = field(default_factory=CacheSizes)
    storage: Storage = field(default_factory=Storage)
    changes: tuple[Change, ...] = ()
    measured_s: float = MEASURED_S

    @property
    def numbers(self) -> int:
        """All replicas that there are at any time."""
        return self.replicas + sum(len(change.join) for change in self.changes)


@dataclass
class Routed:
    """What reached the replicas. Of each asking [A]: a request, or a stream that opened, or opened again."""

    asked_s: list[float] = field(default_factory=list)
    ready_s: list[float] = field(default_factory=list)  # its scene is there, so that it joins the replica's queue
    end_s: list[float] = field(default_factory=list)  # of a stream, else 0
    replica: list[int] = field(default_factory=list)
    scene: list[int] = field(default_factory=list)
    source: list[int] = field(default_factory=list)


class Router:
    """Event by event: which replica each request and stream gets, and where it finds the scene.

    Waiting in the queues of replicas is computed afterwards. Until then a request counts as open for the time of its
    fetch, its work, and the mean wait at a replica with so many streams (`mean_waits`).
    """

    def __init__(
        self, traffic: Traffic, case: Case, kinds: Sequence[SceneCosts], seed: int, generator: np.random.Generator
    ) -> None:
        """`kinds`: the costs of small and of large scenes."""
        self._traffic = list(zip(traffic.time_s.tolist(), traffic.length_s.tolist(), strict=True))
        self._scene: list[int] = traffic.scene.tolist()
        self._door: list[int] = traffic.door.tolist()
        self._case, self._seed, self._generator = case, seed, generator
        self._costs: list[SceneCosts] = [kinds[large] for large in traffic.large.tolist()]
        self._caches = [ReplicaCache(case.sizes, self._costs, case.storage) for _ in range(case.numbers)]
        self._open = [OpenRequests(case.numbers) for _ in (GRPC, HTTP)]
        self._streams: list[set[int]] = [set() for _ in range(case.numbers)]  # indices of askings
        self._waits = mean_waits(case.workload, kinds)
        self._later: list[tuple[float, int, Callable[[float], None]]] = []  # a heap; its numbers order equal times
        self._number = itertools.count()
        self._routed = Routed()
        self._origin: list[int] = []  # of each asking, its place in the traffic
        self._live(range(case.replicas))

    def run(self) -> Routed:
        """Send all traffic to replicas."""
        for change in self._case.changes:
            self._plan(change.time_s, partial(self._change, change))
        for origin, (now_s, length_s) in enumerate(self._traffic):
            while self._later and self._later[0][0] <= now_s:
                time_s, _, happen = heapq.heappop(self._later)
                happen(time_s)
            self._ask(origin, now_s + length_s if length_s else 0.0, now_s)
        return self._routed

    def _live(self, numbers: Sequence[int]) -> None:
        self._alive, scenes = set(numbers), self._case.workload.scenes
        self._balancers = [self._case.policy.balancer(numbers, door, scenes, self._seed) for door in (GRPC, HTTP)]

    def _plan(self, time_s: float, happen: Callable[[float], None]) -> None:
        heapq.heappush(self._later, (time_s, next(self._number), happen))

    def _ask(self, origin: int, end_s: float, now_s: float) -> None:
        """A request (`end_s` 0), or a stream until then."""
        routed, scene, door = self._routed, self._scene[origin], self._door[origin]
        opened = self._open[door]
        replica = self._balancers[door].choose(scene, opened)
        source, ready_s = self._caches[replica].ask(scene, now_s)
        opened.of[replica] += 1
        opened.total += 1
        index = len(routed.asked_s)
        self._origin.append(origin)
        for one, value in zip(fields(Routed), (now_s, ready_s, end_s, replica, scene, source), strict=True):
            getattr(routed, one.name).append(value)
        if end_s:
            self._streams[replica].add(index)
            until_s = end_s
        else:
            until_s = ready_s + self._time_s(replica, scene, source)
        self._plan(until_s, lambda now_s: self._close(index, replica, opened))

    def _time_s(self, replica: int, scene: int, source: Source) -> float:
        costs = self._costs[scene]
        wait_s = self._waits[min(len(self._streams[replica]), len(self._waits) - 1)]
        return wait_s + costs.frame_s + (costs.load_s if source is not Source.MEMORY else 0.0) + costs.overhead_s

    def _close(self, index: int, replica: int, opened: OpenRequests) -> None:
        self._streams[replica].discard(index)
        if replica in self._alive:
            opened.of[replica] -= 1
            opened.total -= 1

    def _change(self, change: Change, now_s: float) -> None:
        """The balancers know at once; the streams of dead replicas come again, one by one."""
        again = [index for replica in change.die for index in sorted(self._streams[replica])]
        for opened in self._open:
            for replica in change.die:
                opened.total -= opened.of[replica]
                opened.of[replica] = 0
        self._live(sorted((self._alive - set(change.die)) | set(change.join)))
        for index, after_s in zip(again, self._generator.uniform(*RECONNECTED_S, len(again)).tolist(), strict=True):
            until_s, self._routed.end_s[index] = self._routed.end_s[index], now_s
            if now_s + after_s < until_s:
                self._plan(now_s + after_s, partial(self._ask, self._origin[index], until_s))


def mean_waits(workload: Workload, kinds: Sequence[SceneCosts]) -> list[float]:
    """The mean wait [streams] at a replica with so many streams, up to the number that fills it: seconds.

    Pollaczek and Khinchine: of Poisson arrivals at a rate λ with a mean time of work E[S], W = λ·E[S²] / 2(1 − λ·E[S]).
    """
    shares = (1.0 - workload.large_share, workload.large_share)
    mean = sum(share * kind.frame_s for share, kind in zip(shares, kinds, strict=True))
    squared = sum(share * kind.frame_s**2 * math.exp(kind.spread**2) for share, kind in zip(shares, kinds, strict=True))
    waits = []
    for streams in range(math.ceil(1.0 / (mean * workload.poses_per_s))):
        rate = streams * workload.poses_per_s
        waits.append(min(PATIENCE_S, rate * squared / (2.0 * (1.0 - rate * mean))))
    return [*waits, PATIENCE_S]


def begins(arrival_s: Floats, work_s: Floats, stream: Integers, patience_s: float = math.inf) -> Floats:  # [N] all
    """The queue of a replica: the time at which the work on each begins, NaN for what was replaced or refused.

    Arrivals ascend; first come, first served. A pose of a stream that comes while the one before it still waits takes
    its place, as in the mode `latest`; what would wait longer than the patience is refused at once.
    """
    begun: list[float] = []
    free_s = 0.0  # when the process has done what it was given
    latest: dict[int, int] = {}
    for index, (now, work, one) in enumerate(zip(arrival_s.tolist(), work_s.tolist(), stream.tolist(), strict=True)):
        before = latest.get(one)
        if before is not None and begun[before] > now:
            begun.append(begun[before])
            begun[before] = math.nan
            latest[one] = index
            continue
        start = max(free_s, now)
        if start - now > patience_s:
            begun.append(math.nan)
            continue
        free_s = start + work
        begun.append(start)
        if one != ALONE:
            latest[one] = index
    return np.array(begun)


@dataclass(frozen=True)
class Outcome:
    """One run, in the window in which it is measured. Times in ms, from the sending of a pose to its frame."""

    hits: float  # share of requests and opening streams whose scene was in the replica's memory
    fetched_mb_per_s: float  # from object storage, by all replicas
    busy: float  # mean share of a replica's time that its work takes
    most_over_mean: float  # work of the busiest replica
    variation: float  # of the replicas' work, standard deviation over mean
    overfull: float  # share of replicas with more work than time
    wait_ms: float  # mean in the queue, as `ultragray_queue_seconds` counts it: of a pose since it came
    wait_p95_ms: float
    pose_p50_ms: float
    pose_p99_ms: float
    pose_p999_ms: float
    unanswered: float  # share of poses that a newer one replaced, or that were refused
    request_p50_ms: float  # of single requests and of the first pose of a stream
    request_p99_ms: float
    request_p999_ms: float
    refused: float  # share of requests
    replicas_of_hottest: float  # that were asked for the most popular scene


def run(case: Case, kinds: Sequence[SceneCosts], seed: int) -> Outcome:
    """One run: the same seed has the same clients in every case with the same workload."""
    clients, others = (np.random.default_rng((seed, part)) for part in range(2))
    end_s = SETTLING_S + case.measured_s
    traffic = draw_traffic(case.workload, end_s, clients)
    routed = Router(traffic, case, kinds, seed, others).run()
    return _evaluate(routed, traffic, case, kinds, (SETTLING_S, end_s), others)


def _evaluate(
    routed: Routed,
    traffic: Traffic,
    case: Case,
    kinds: Sequence[SceneCosts],
    window_s: tuple[float, float],
    generator: np.random.Generator,
) -> Outcome:
    """The figures of a run: what replicas have to do in the window, through the queue of each.

    A stream is a pose each period from the time at which its scene is ready; the time of a frame is log-normal.
    """
    first_s, last_s = window_s
    asked, ready, end = (np.array(one) for one in (routed.asked_s, routed.ready_s, routed.end_s))
    replica, scene, source = (np.array(one) for one in (routed.replica, routed.scene, routed.source))
    # Requests and the first poses of streams, then all poses of streams: each by its asking.
    first = np.flatnonzero((ready >= first_s) & (ready < last_s))
    period = 1.0 / case.workload.poses_per_s
    begin = np.maximum(ready, first_s) + generator.uniform(0.0, period, len(ready))
    counts = np.where(end > 0.0, np.maximum(0, np.ceil((np.minimum(end, last_s) - begin) / period)), 0).astype(np.int64)
    posed = np.repeat(np.arange(len(counts)), counts)
    sent = begin[posed] + (np.arange(len(posed)) - np.repeat(np.cumsum(counts) - counts, counts)) * period
    asking = np.concatenate([first, posed])
    large = traffic.large[scene[asking]].astype(int)
    frame, spread, overhead, load = (
        np.array([getattr(kind, name) for kind in kinds])[large]
        for name in ("frame_s", "spread", "overhead_s", "load_s")
    )
    loads = np.concatenate([source[first] != Source.MEMORY, np.zeros(len(posed), np.bool_)])
    work = frame * np.exp(spread * generator.standard_normal(len(asking)) - spread**2 / 2.0) + loads * load
    arrival = np.concatenate([ready[first], sent])
    since = np.concatenate([asked[first], sent])
    stream = np.concatenate([np.full(len(first), ALONE), posed])
    order = np.lexsort((arrival, replica[asking]))
    place, arrival, since, work, overhead, stream = (
        one[order] for one in (replica[asking], arrival, since, work, overhead, stream)
    )
    bounds = np.searchsorted(place, np.arange(case.numbers + 1))
    begun = np.concatenate(
        [
            begins(arrival[low:high], work[low:high], stream[low:high], PATIENCE_S)
            for low, high in itertools.pairwise(bounds.tolist())
        ]
    )
    answered, of_stream = ~np.isnan(begun), stream != ALONE
    poses, requests = answered & of_stream, answered & ~of_stream
    waits_ms = 1000.0 * (begun - arrival)[answered]
    taken_ms = 1000.0 * (begun - since + work + overhead)
    dead = {number for change in case.changes for number in change.die}
    alive = [number for number in range(case.numbers) if number not in dead]
    busy = np.bincount(place, work, minlength=case.numbers)[alive] / (last_s - first_s)
    inside = (asked >= first_s) & (asked < last_s)
    sizes = np.array([kind.file_bytes for kind in kinds])[traffic.large[scene].astype(int)]
    return Outcome(
        hits=float((source[inside] == Source.MEMORY).mean()),
        fetched_mb_per_s=float(sizes[inside & (source == Source.STORAGE)].sum() / 1e6 / (last_s - first_s)),
        busy=float(busy.mean()),
        most_over_mean=float(busy.max() / busy.mean()),
        variation=float(busy.std() / busy.mean()),
        overfull=float((busy > 1.0).mean()),
        wait_ms=float(waits_ms.mean()),
        wait_p95_ms=float(np.quantile(waits_ms, 0.95)),
        **_quantiles("pose", taken_ms[poses]),
        unanswered=float(1.0 - poses.sum() / of_stream.sum()),
        **_quantiles("request", taken_ms[requests]),
        refused=float(1.0 - requests.sum() / (~of_stream).sum()),
        replicas_of_hottest=float(len(np.unique(replica[inside & (scene == 0)]))),
    )


def _quantiles(what: str, times_ms: Floats) -> dict[str, float]:
    found = np.quantile(times_ms, [0.5, 0.99, 0.999]).tolist()
    return dict(zip((f"{what}_p50_ms", f"{what}_p99_ms", f"{what}_p999_ms"), found, strict=True))


POLICIES = {
    "random": Policy("random"),
    "least request": Policy("least request"),
    "ring hash": Policy(factor=None),
    f"ring hash, {DECIDED.hash_balance_factor}%": Policy(),
}
MIB = 2**20
# The policies are compared at full size; all else in a quarter of it: as many replicas, clients, scenes.
QUARTER = Case(replicas=250, workload=Workload(clients=25_000, scenes=2_500))
# One in twenty dies, and as many others join.
CHANGES = (
    Change(SETTLING_S + 2.0, die=range(0, 250, 20)),
    Change(SETTLING_S + 8.0, join=range(250, 263)),
)
_WHILE_CHANGING = replace(QUARTER, changes=CHANGES, measured_s=16.0)


def _with_streams(count: int) -> Case:
    """`count` of a thousand clients have a stream."""
    return replace(QUARTER, workload=replace(QUARTER.workload, streaming_share=count / 1000.0))


STUDIES: Mapping[str, Mapping[str, Case]] = {
    "policies": {name: Case(policy) for name, policy in POLICIES.items()},
    "factors": {
        "none": replace(QUARTER, policy=Policy(factor=None)),
        **{f"{factor}%": replace(QUARTER, policy=Policy(factor=factor)) for factor in (101, 110, 125, 150, 200)},
    },
    "caches": {
        **{f"{mib:,} MiB": replace(QUARTER, sizes=CacheSizes(memory=mib * MIB)) for mib in (256, 512, 1024, 4096)},
        "4,096 MiB, random": replace(QUARTER, policy=Policy("random")),
        "4,096 MiB, slower storage": replace(QUARTER, storage=Storage(first_byte_s=0.2, bytes_per_s=25e6)),
    },
    "load": {f"{count / 10:g}": _with_streams(count) for count in (20, 30, 40, 50, 60, 70, 80)},
    "changes": {
        "none": replace(_WHILE_CHANGING, changes=()),
        **{
            name: replace(_WHILE_CHANGING, policy=POLICIES[name])
            for name in ("random", f"ring hash, {DECIDED.hash_balance_factor}%")
        },
    },
}
