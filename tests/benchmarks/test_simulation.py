"""The simulation of replicas: right where the answer is known, true to Envoy's rules, the same for the same seed."""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from ..scripts import benchmark

balancers = benchmark("scaling.balancers")
caches = benchmark("scaling.caches")
cases = benchmark("scaling.cases")
checks = benchmark("scaling.checks")
costs = benchmark("scaling.costs")
outcome = benchmark("scaling.outcome")
picture = benchmark("scaling.picture")
queues = benchmark("scaling.queues")
routing = benchmark("scaling.routing")
study = benchmark("scaling.study")
tables = benchmark("scaling.tables")
theory = benchmark("scaling.theory")
workload = benchmark("scaling.workload")
documents, registry = benchmark("documents"), benchmark("registry")

SMALL = costs.SceneCosts(90_000, 5_400_000, 13_500_000, 0.025, 0.003, 0.001, 0.25)
LARGE = costs.SceneCosts(500_000, 30_000_000, 75_000_000, 0.14, 0.0045, 0.001, 0.25)
KINDS = (SMALL, LARGE)
FEW = workload.Workload(clients=2_000, scenes=200, request_every_s=10.0)
REPLICAS = 20


def small(**changed: object) -> object:
    return study.Case(**{"workload": FEW, "replicas": REPLICAS, "measured_s": 2.0, **changed})


@pytest.fixture(autouse=True)
def settled_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "SETTLING_S", 10.0)


def opened(*counts: int) -> object:
    """Open requests of as many replicas."""
    found = balancers.OpenRequests(len(counts))
    found.of, found.total = list(counts), sum(counts)
    return found


# Where the answer is known.


@pytest.mark.parametrize("name", list(checks.CHECKS))
def test_the_simulation_gives_the_known_answer(name: str) -> None:
    known, simulate = checks.CHECKS[name]
    answers = [simulate(np.random.default_rng(seed)) for seed in range(3)]
    assert np.mean(answers) == pytest.approx(known, rel=0.06)


def test_erlangs_formula_gives_the_values_of_tables() -> None:
    assert theory.waiting_share(0.5, 1) == pytest.approx(0.5)
    assert theory.waiting_share(1.0, 2) == pytest.approx(1.0 / 3.0)
    assert theory.mean_wait(0.9, 1) == pytest.approx(9.0)
    with pytest.raises(ValueError, match="load must be at least 0 and below the 2 processes, got 2"):
        theory.waiting_share(2.0, 2)


# Queues.


def test_what_comes_while_a_replica_works_waits_in_order() -> None:
    alone = np.full(3, queues.ALONE)
    begun = queues.begins(np.array([0.0, 1.0, 1.5]), np.array([2.0, 2.0, 1.0]), alone)
    assert begun.tolist() == [0.0, 2.0, 4.0]
    begun = queues.begins(np.array([0.0, 1.0, 1.5]), np.array([2.0, 2.0, 1.0]), alone, processes=2)
    assert begun.tolist() == [0.0, 1.0, 2.0]


def test_a_pose_takes_the_place_of_the_one_of_its_stream_that_waits() -> None:
    begun = queues.begins(np.array([0.0, 1.0, 2.0, 2.5]), np.full(4, 4.0), np.array([7, 7, 7, 8]))
    assert math.isnan(begun[1])
    assert begun[[0, 2, 3]].tolist() == [0.0, 4.0, 8.0]


def test_what_would_wait_longer_than_the_patience_is_refused() -> None:
    alone = np.full(3, queues.ALONE)
    begun = queues.begins(np.array([0.0, 0.1, 0.2]), np.array([2.0, 1.0, 1.0]), alone, patience_s=1.85)
    assert begun[0] == 0.0
    assert math.isnan(begun[1])
    assert begun[2] == 2.0


# Caches.


def test_a_scene_is_fetched_once_and_loaded_again_after_it_was_dropped() -> None:
    sizes = caches.CacheSizes(memory=2 * SMALL.resident_bytes, folder=10 * SMALL.file_bytes)
    cache = caches.ReplicaCache(sizes, [SMALL] * 4, costs.Storage(first_byte_s=0.5, bytes_per_s=math.inf))
    sources = [cache.ask(scene, float(now)) for now, scene in enumerate((0, 1, 0, 2, 1, 0))]
    memory, folder, storage = caches.Source.MEMORY, caches.Source.FOLDER, caches.Source.STORAGE
    assert sources == [(storage, 0.5), (storage, 1.5), (memory, 2.0), (storage, 3.5), (folder, 4.0), (folder, 5.0)]


def test_the_file_that_was_least_recently_used_is_fetched_again() -> None:
    sizes = caches.CacheSizes(memory=1, folder=2 * SMALL.file_bytes)  # the scene asked for last stays loaded
    cache = caches.ReplicaCache(sizes, [SMALL] * 3, costs.Storage())
    sources = [cache.ask(scene, 0.0)[0] for scene in (0, 1, 0, 2, 0, 1)]
    folder, storage = caches.Source.FOLDER, caches.Source.STORAGE
    assert sources == [storage, storage, folder, storage, folder, storage]


def test_who_asks_during_a_fetch_waits_for_its_end() -> None:
    storage = costs.Storage(first_byte_s=2.0, bytes_per_s=math.inf)
    cache = caches.ReplicaCache(caches.CacheSizes(), [SMALL], storage)
    cache.ask(0, 0.0)
    assert cache.ask(0, 0.5) == (caches.Source.MEMORY, 2.0)


# Envoy's rules.


def bounded(factor: int, replicas: int = 4, home: int = 0) -> object:
    those = balancers.Replicas.equal(range(replicas))
    return balancers.BoundedLoad(balancers.Hashed(np.full((1, 9), home), 0), those, factor, 0)


def test_a_replica_above_its_share_is_passed_over() -> None:
    balancer = bounded(125)
    assert balancer.choose(0, opened(4, 4, 4, 4)) == 0  # a share is ceil(ceil(1.25 x 17) / 4) = 6
    assert balancer.choose(0, opened(6, 3, 3, 4)) == 0
    assert balancer.choose(0, opened(7, 3, 3, 3)) != 0
    assert balancer.choose(0, opened(1, 0, 0, 0)) == 0  # a share is at least 1
    with pytest.raises(ValueError, match="factor must be above 100 per cent, got 100"):
        bounded(100)


def test_the_replicas_that_relieve_a_home_depend_on_the_scene_alone() -> None:
    full = opened(*([20] + [0] * 19))
    chosen = [bounded(110, 20).choose(scene, full) for scene in range(9)]
    assert chosen == [bounded(110, 20).choose(scene, full) for scene in range(9)]
    assert len(set(chosen)) > 4


def test_no_replica_has_more_open_requests_than_the_bound_lets_it() -> None:
    balancer, load = bounded(110, 10), opened(*([0] * 10))
    for _ in range(500):
        replica = balancer.choose(0, load)
        load.of[replica] += 1
        load.total += 1
    assert max(load.of) <= math.ceil(math.ceil(1.1 * 500) / 10) + 1


def test_a_weight_gives_a_larger_part_of_ring_and_bound() -> None:
    replicas = balancers.Replicas(range(10), np.array([3.0] * 5 + [1.0] * 5) / 20.0)
    homes = balancers.ring_homes(replicas, balancers.Hashes(0), 20_000, 1, 10_000)
    counts = np.bincount(homes[0], minlength=10)
    assert counts[:5].sum() / counts[5:].sum() == pytest.approx(3.0, rel=0.05)
    balancer = balancers.BoundedLoad(balancers.Hashed(np.zeros((1, 1), int), 0), replicas, 110, 0)
    assert balancer.choose(0, opened(*([15] + [0] * 9))) != 0
    assert balancer.choose(0, opened(*([15] * 5 + [5] * 5))) == 0


# Of a ring of the same size the others get more points, so that more scenes move than those of the dead replica.
@pytest.mark.parametrize(("name", "most"), [("ring hash", 0.07), ("Maglev", 0.2)])
def test_only_some_scenes_move_where_a_replica_dies(name: str, most: float) -> None:
    def homes(numbers: list[int]) -> np.ndarray:
        those, hashes = balancers.Replicas.equal(numbers), balancers.Hashes(0)
        if name == "Maglev":
            return np.asarray(balancers.maglev_homes(those, hashes, 5_000, 1)[0])
        return np.asarray(balancers.ring_homes(those, hashes, 5_000, 1, 4096)[0])

    before, after = homes(list(range(20))), homes(list(range(1, 20)))
    moved = before != after
    assert 0.0 < moved[before != 0].mean() < most
    assert moved[before == 0].all()
    assert (before == 0).mean() == pytest.approx(0.05, abs=0.02)


def test_maglev_gives_every_replica_the_same_part() -> None:
    homes = balancers.maglev_homes(balancers.Replicas.equal(range(20)), balancers.Hashes(0), 200_000, 1)
    counts = np.bincount(homes[0])
    assert counts.max() / counts.mean() < 1.05


def test_of_two_replicas_the_one_with_fewer_open_requests_is_taken() -> None:
    balancer = balancers.LeastRequest(balancers.Replicas.equal(range(4)), 0)
    counts = Counter(balancer.choose(0, opened(0, 5, 5, 5)) for _ in range(4_000))
    assert counts[0] / 4_000 == pytest.approx(1.0 - 0.75**2, abs=0.03)


def test_both_doors_have_the_same_homes_only_where_ports_are_not_hashed() -> None:
    those = balancers.Replicas.equal(range(REPLICAS))
    for one_home in (True, False):
        policy = study.Policy(factor=None, one_home=one_home)
        grpc, http = (policy.balancer(those, door, 200, 0).homes for door in (workload.GRPC, workload.HTTP))
        assert (grpc == http).all() == one_home


# Whole runs.


def test_the_same_seed_gives_the_same_figures() -> None:
    case = small()
    assert study.run(case, KINDS, 1) == study.run(case, KINDS, 1) != study.run(case, KINDS, 2)


def test_scenes_are_found_in_memory_by_affinity_and_not_by_chance() -> None:
    sizes = caches.CacheSizes(memory=20 * LARGE.resident_bytes)
    at_home = study.run(small(sizes=sizes), KINDS, 0)
    by_chance = study.run(small(sizes=sizes, policy=study.Policy("random")), KINDS, 0)
    assert at_home.hits > 0.9 > by_chance.hits + 0.1
    assert at_home.fetched_mb_per_s < 0.3 * by_chance.fetched_mb_per_s
    assert at_home.busy < by_chance.busy


def test_a_bound_keeps_the_home_of_a_hot_scene_from_overflowing() -> None:
    hot = small(workload=workload.Workload(clients=2_000, scenes=200, exponent=1.5))
    bound = study.run(hot, KINDS, 0)
    unbound = study.run(small(workload=hot.workload, policy=study.Policy(factor=None)), KINDS, 0)
    assert unbound.replicas_of_hottest == 1.0
    assert bound.replicas_of_hottest > 3.0
    assert bound.unanswered < 0.2 * unbound.unanswered


def test_more_envoys_each_bound_less() -> None:
    one, many = (study.run(small(proxies=proxies), KINDS, 0) for proxies in (1, 16))
    assert many.most_over_mean > 1.5 * one.most_over_mean


def test_streams_of_dead_replicas_come_again_and_nothing_reaches_the_dead() -> None:
    change = routing.Change(11.0, die=range(0, REPLICAS, 4), join=(REPLICAS,))
    random = np.random.default_rng(0)
    traffic = workload.draw_traffic(FEW, 14.0, 1, random)
    cluster = routing.Cluster(
        replicas=REPLICAS,
        speeds=[1.0] * (REPLICAS + 1),
        sizes=caches.CacheSizes(),
        storage=costs.Storage(),
        proxies=1,
        balancers=lambda alive: [balancers.LeastRequest(balancers.Replicas.equal(alive), 0)] * 2,
        changes=(change,),
    )
    routed = routing.route(traffic, FEW, KINDS, cluster, random)
    asked, end, replica = (np.array(one) for one in (routed.asked_s, routed.end_s, routed.replica))
    dead = np.isin(replica, list(change.die))
    assert asked[dead].max() < 11.0
    assert end[dead].max() <= 11.0
    cut = int((dead & (end == 11.0)).sum())
    again = len(asked) - len(traffic.time_s)
    assert cut > 0
    assert 0 < again <= cut
    assert (replica[asked > 11.0] == REPLICAS).any()


def test_the_work_of_replicas_is_that_of_the_clients() -> None:
    found = study.run(small(), KINDS, 0)
    mean_s = 0.8 * SMALL.frame_s + 0.2 * LARGE.frame_s
    work = (FEW.streams * FEW.poses_per_s + FEW.requests_per_s) * mean_s / REPLICAS
    assert found.busy == pytest.approx(work, rel=0.2)


def test_a_confidence_interval_is_students() -> None:
    assert outcome.mean_with_confidence([1.0, 2.0, 3.0]) == [2.0, 2.5]


# What is written.


def test_the_recorded_figures_are_those_of_the_defaults_and_of_every_case() -> None:
    recorded = json.loads(registry.FIGURES["simulation"].kept.read_text(encoding="utf-8"))
    assert recorded["policy"] == asdict(study.Policy())
    assert {name: list(rows) for name, rows in recorded["studies"].items()} == {
        name: list(rows) for name, rows in cases.STUDIES.items()
    }


def test_every_study_has_a_table() -> None:
    recorded = json.loads(registry.FIGURES["simulation"].kept.read_text(encoding="utf-8"))
    for name in tables.STUDIES:
        head, _, *rows = documents.block(f"simulated {name}").splitlines()
        shown = recorded["studies"].get(name, recorded["studies"]["policies"])
        assert all(f"| {row} |" in "\n".join(rows) for row in shown)
        assert all(row.count("|") == head.count("|") for row in rows[: len(shown)])


def test_the_picture_is_drawn(tmp_path: Path) -> None:
    recorded = json.loads(registry.FIGURES["simulation"].kept.read_text(encoding="utf-8"))
    picture.draw(recorded, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000
