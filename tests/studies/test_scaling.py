"""The simulation of replicas: right where the answer is known, true to Envoy's rules, the same for the same seed."""

import math

import numpy as np
import pytest

from ultragray_studies import scaling
from ultragray_studies.scaling import (
    ALONE,
    HTTP,
    BoundedLoad,
    CacheSizes,
    Case,
    Change,
    OpenRequests,
    Policy,
    ReplicaCache,
    Ring,
    Router,
    SceneCosts,
    Source,
    Storage,
    Workload,
    begins,
    draw_traffic,
    run,
)

SMALL = SceneCosts(90_000, 5_400_000, 13_500_000, 0.025, 0.003, 0.001, 0.25)
LARGE = SceneCosts(500_000, 30_000_000, 75_000_000, 0.14, 0.0045, 0.001, 0.25)
KINDS = (SMALL, LARGE)
FEW = Workload(clients=2_000, scenes=200, request_every_s=10.0)
REPLICAS = 20
ARRIVALS = 200_000


def small(**changed):
    return Case(**{"workload": FEW, "replicas": REPLICAS, "measured_s": 2.0, **changed})


@pytest.fixture(autouse=True)
def settled_soon(monkeypatch):
    monkeypatch.setattr(scaling, "SETTLING_S", 10.0)


def opened(*counts):
    """Open requests of as many replicas."""
    found = OpenRequests(len(counts))
    found.of, found.total = list(counts), sum(counts)
    return found


# Where the answer is known.


@pytest.mark.parametrize(("constant", "known"), [(False, 4.0), (True, 2.0)])  # ρ/(1 − ρ), and half of it
def test_the_mean_wait_at_80_percent_is_that_of_queueing_theory(constant, known):
    waits = []
    for seed in range(3):
        generator = np.random.default_rng(seed)
        arrival_s = np.cumsum(generator.exponential(1.0 / 0.8, ARRIVALS))
        work_s = np.ones(ARRIVALS) if constant else generator.exponential(1.0, ARRIVALS)
        waits.append((begins(arrival_s, work_s, np.full(ARRIVALS, ALONE)) - arrival_s).mean())
    assert np.mean(waits) == pytest.approx(known, rel=0.06)


def test_the_hits_of_a_cache_are_ches_approximation():
    same, slots, shares = SceneCosts(1, 1, 1, 0.0, 1.0, 0.0, 0.0), 100, Workload().popularity()

    def held(time):
        return float(-np.expm1(-time * shares).sum())

    low, high = 0.0, 1e6
    for _ in range(80):
        middle = (low + high) / 2.0
        low, high = (middle, high) if held(middle) < slots else (low, middle)
    known = float((shares * -np.expm1(-low * shares)).sum())
    cache = ReplicaCache(CacheSizes(memory=slots, folder=1), [same] * len(shares), Storage())
    asked = np.random.default_rng(0).choice(len(shares), 100_000, p=shares)
    sources = np.array([cache.ask(scene, 0.0)[0] for scene in asked.tolist()])
    assert (sources[25_000:] == Source.MEMORY).mean() == pytest.approx(known, rel=0.06)


# Queues and caches.


def test_a_pose_takes_the_place_of_the_one_of_its_stream_that_waits():
    begun = begins(np.array([0.0, 1.0, 2.0, 2.5]), np.full(4, 4.0), np.array([7, 7, 7, 8]))
    assert math.isnan(begun[1])
    assert begun[[0, 2, 3]].tolist() == [0.0, 4.0, 8.0]


def test_a_scene_is_fetched_once_and_loaded_again_after_it_was_dropped():
    sizes = CacheSizes(memory=2 * SMALL.resident_bytes, folder=10 * SMALL.file_bytes)
    cache = ReplicaCache(sizes, [SMALL] * 4, Storage(first_byte_s=0.5, bytes_per_s=math.inf))
    sources = [cache.ask(scene, float(now)) for now, scene in enumerate((0, 1, 0, 2, 1, 0))]
    memory, folder, storage = Source.MEMORY, Source.FOLDER, Source.STORAGE
    assert sources == [(storage, 0.5), (storage, 1.5), (memory, 2.0), (storage, 3.5), (folder, 4.0), (folder, 5.0)]


# Envoy's rules.


class Home:
    """Of every scene the first replica."""

    def choose(self, scene, open_requests):
        return 0


def bounded(factor, replicas=4):
    return BoundedLoad(Home(), range(replicas), factor, 0)


def test_a_replica_above_its_share_is_passed_over():
    balancer = bounded(125)
    assert balancer.choose(0, opened(4, 4, 4, 4)) == 0  # a share is ceil(ceil(1.25 x 17) / 4) = 6
    assert balancer.choose(0, opened(6, 3, 3, 4)) == 0
    assert balancer.choose(0, opened(7, 3, 3, 3)) != 0
    assert balancer.choose(0, opened(1, 0, 0, 0)) == 0  # a share is at least 1
    with pytest.raises(ValueError, match="factor must be above 100 per cent, got 100"):
        bounded(100)


def test_only_some_scenes_move_where_a_replica_dies():
    before, after = (Ring(numbers, 5_000, 4096, 0).homes for numbers in (range(20), range(1, 20)))
    moved = before != after
    assert 0.0 < moved[before != 0].mean() < 0.07  # of a ring of the same size the others get more points
    assert moved[before == 0].all()
    assert (Ring(range(20), 5_000, 4096, 0, HTTP).homes != before).mean() > 0.9, "doors have homes of their own"


# Whole runs.


def test_the_same_seed_gives_the_same_figures():
    assert run(small(), KINDS, 1) == run(small(), KINDS, 1) != run(small(), KINDS, 2)


def test_scenes_are_found_in_memory_by_affinity_and_not_by_chance():
    sizes = CacheSizes(memory=20 * LARGE.resident_bytes)
    at_home = run(small(sizes=sizes), KINDS, 0)
    by_chance = run(small(sizes=sizes, policy=Policy("random")), KINDS, 0)
    assert at_home.hits > 0.9 > by_chance.hits + 0.1
    assert at_home.fetched_mb_per_s < 0.3 * by_chance.fetched_mb_per_s
    assert at_home.busy < by_chance.busy


def test_a_bound_keeps_the_home_of_a_hot_scene_from_overflowing():
    hot = Workload(clients=2_000, scenes=200, exponent=1.5)
    bound, unbound = (run(small(workload=hot, policy=policy), KINDS, 0) for policy in (Policy(), Policy(factor=None)))
    assert unbound.replicas_of_hottest <= 2.0  # a home behind each door
    assert bound.replicas_of_hottest > 3.0
    assert bound.unanswered < 0.2 * unbound.unanswered


def test_streams_of_dead_replicas_come_again_and_nothing_reaches_the_dead():
    change = Change(11.0, die=range(0, REPLICAS, 4), join=(REPLICAS,))
    generator = np.random.default_rng(0)
    traffic = draw_traffic(FEW, 14.0, generator)
    case = small(policy=Policy("least request"), changes=(change,))
    routed = Router(traffic, case, KINDS, 0, generator).run()
    asked, end, replica = (np.array(one) for one in (routed.asked_s, routed.end_s, routed.replica))
    dead = np.isin(replica, list(change.die))
    assert asked[dead].max() < 11.0
    assert end[dead].max() <= 11.0
    cut = int((dead & (end == 11.0)).sum())
    assert 0 < len(asked) - len(traffic.time_s) <= cut
    assert (replica[asked > 11.0] == REPLICAS).any()
