"""Replicas and workers of several hosts over a bucket, behind a real Envoy, killed and drained in turn.

Clients of all kinds ask them meanwhile: no frame is wrong, none comes twice, no job is lost, streams go on within
seconds, and a scene stays where it is loaded.
ULTRAGRAY_REPLICAS_CLIENTS, _SCENES, _HOSTS, _WORKERS and _SECONDS size the run; make test-replicas has the full one.
"""

import asyncio
import itertools
import json
import os
import statistics
from collections import Counter
from contextlib import ExitStack

import pytest

from ultragray_studies.bench.report import measured
from ultragray_workers.backup.copying import copy_scenes
from ultragray_workers.storage.location import open_storage

from ..docker.envoy import Envoy, program, script
from ..service.conftest import DEMO_PROBE, make_scene
from ..surroundings import ROOT
from ..waiting import at_this_load
from .hosts import ReplicaHost, WorkerHost
from .visitors import Expected, Visitors, finished

pytestmark = pytest.mark.long


def _size(name, default):
    return float(os.environ.get(f"ULTRAGRAY_REPLICAS_{name}", default))


CLIENTS, SCENES, HOSTS, WORKERS = (
    int(_size(*one)) for one in (("CLIENTS", 24), ("SCENES", 8), ("HOSTS", 3), ("WORKERS", 1))
)
SECONDS = _size("SECONDS", 60)
PAUSE_S = _size("PAUSE_S", 1.0)  # of a client, between its poses
RECORD = os.environ.get("ULTRAGRAY_REPLICAS_RECORD")
HOT = "scene0"
HOT_SHARE = 5  # one client of so many is of the hot scene
HOT_REPLICAS = 2
RESUMES_WITHIN_S = 2.0
BETWEEN_DISRUPTIONS_S = 5.0
JOB_EVERY_S = 10.0
DOORS = ("ordered", "latest", "http", "websocket")


class Cluster:
    """All hosts, the proxy before them, and what was done to them."""

    def __init__(self, folder, bucket, postgres, started):
        made = folder / "made"
        made.mkdir()
        self.expected = {}
        for number in range(SCENES):
            path = made / f"scene{number}.ugr"
            make_scene(seed=number, probe=DEMO_PROBE).save(path)
            self.expected[path.stem] = Expected.of(path)
        copy_scenes(open_storage(str(made)), open_storage(f"{bucket}/data"))
        shared = {
            "ULTRAGRAY_DATA_FOLDER": f"{bucket}/data",
            "ULTRAGRAY_ARTIFACT_FOLDER": f"{bucket}/artifacts",
            "ULTRAGRAY_DATABASE_URL": postgres.create_database(),
        }
        self.hosts = []
        for number in range(HOSTS):
            self.hosts.append(ReplicaHost(folder / f"replica{number}", shared))
            started.callback(self.hosts[-1].stop)
        for host in self.hosts:
            host.wait_until_serving()
        self.workers = []
        for number in range(WORKERS):
            self.workers.append(WorkerHost(folder / f"worker{number}", shared))
            started.callback(self.workers[-1].stop)
        replicas = [script().Replica("127.0.0.1", host.http_port, host.grpc_port) for host in self.hosts]
        self.envoy = started.enter_context(Envoy(folder, replicas, {HOT: HOT_REPLICAS}))
        self.envoy.wait_for()
        self.disruptions = Counter()
        self.loads = self.frames = 0.0

    def note(self, host):
        """Adds what a replica did since it was started, before it ends."""
        self.loads += len(host.loaded_scenes())
        self.frames += host.frames()

    def homes(self):
        """By scene: the replicas that have it in memory."""
        return dict(Counter(itertools.chain.from_iterable(host.loaded_scenes() for host in self.hosts)))

    def disrupt(self, number):
        """Kills or drains a replica, and now and then kills a worker; returns when all are there again."""
        host = self.hosts[number % len(self.hosts)]
        self.note(host)
        if number % 2:
            assert host.drain() == 0
        else:
            host.strike()
        self.disruptions["drained" if number % 2 else "killed"] += 1
        host.start()
        host.wait_until_serving()
        self.envoy.wait_for()
        if number % len(self.hosts) == 1:
            worker = self.workers[number // len(self.hosts) % len(self.workers)]
            worker.strike()
            worker.start()
            self.disruptions["workers killed"] += 1


@pytest.fixture
def cluster(tmp_path, new_bucket, postgres):
    program()  # skips where there is none
    with ExitStack() as started:
        yield Cluster(tmp_path, new_bucket(), postgres, started)


async def _run(cluster):
    visitors = Visitors(cluster.envoy.http, cluster.envoy.grpc, cluster.expected, PAUSE_S)
    scenes = sorted(cluster.expected)
    tasks = [asyncio.ensure_future(visitors.submit_jobs(scenes, JOB_EVERY_S))]
    for number in range(CLIENTS):
        scene = HOT if number % HOT_SHARE == 0 else scenes[number % len(scenes)]
        tasks.append(asyncio.ensure_future(visitors.visit(DOORS[number // HOT_SHARE % len(DOORS)], scene)))
    loop = asyncio.get_running_loop()
    began = loop.time()
    await asyncio.sleep(SECONDS / 3)  # undisturbed, to see where scenes are
    calm = {
        "replicas_by_scene": dict(sorted((await asyncio.to_thread(cluster.homes)).items())),
        "frames_by_replica": [await asyncio.to_thread(host.frames) for host in cluster.hosts],
    }
    for number in itertools.count():
        if loop.time() - began >= SECONDS and number >= 2:
            break
        await asyncio.to_thread(cluster.disrupt, number)
        await asyncio.sleep(BETWEEN_DISRUPTIONS_S)
    visitors.over.set()
    await asyncio.gather(*tasks)
    for host in cluster.hosts:
        await asyncio.to_thread(cluster.note, host)
    return visitors, calm


def test_frames_and_jobs_of_replicas_that_come_and_go(cluster):
    visitors, calm = asyncio.run(_run(cluster))
    seen = visitors.seen
    states = asyncio.run(finished(cluster.envoy.grpc, seen.jobs, within_s=at_this_load(120.0)))
    if RECORD:
        record = _record(cluster, visitors, calm, states)
        (ROOT / RECORD).parent.mkdir(parents=True, exist_ok=True)
        (ROOT / RECORD).write_text(json.dumps(record, indent=1) + "\n")
    assert not seen.wrong, seen.wrong[:10]
    assert not seen.errors, seen.errors[:10]
    assert set(seen.frames) == set(DOORS)
    assert states == {"succeeded": len(seen.jobs)}
    assert seen.reconnections["ordered"] + seen.reconnections["latest"] > 0
    assert max(seen.resumed_ms) <= 1000 * at_this_load(RESUMES_WITHIN_S)
    homes = calm["replicas_by_scene"]
    assert statistics.mean(homes[scene] for scene in homes if scene != HOT) < HOSTS / 2 + 0.5, homes


def _record(cluster, visitors, calm, states):
    """What the file of the run says."""
    seen = visitors.seen
    resumed = sorted(seen.resumed_ms)
    rendered = calm["frames_by_replica"]
    cold = [count for scene, count in calm["replicas_by_scene"].items() if scene != HOT]
    return {
        "measured": measured(os.cpu_count() or 1),
        "load_average": round(os.getloadavg()[1], 1),  # of five minutes; others may use the machine
        "clients": CLIENTS,
        "scenes": SCENES,
        "replicas": HOSTS,
        "workers": WORKERS,
        "seconds": round(SECONDS),
        "disruptions": dict(cluster.disruptions),
        "frames": dict(sorted(seen.frames.items())),
        "wrong_frames": len(seen.wrong),
        "errors": seen.errors[:20],
        "jobs": dict(states),
        "reconnections": dict(sorted(seen.reconnections.items())),
        "resumed_ms": {
            "count": len(resumed),
            "median": _at(resumed, 0.5),
            "p95": _at(resumed, 0.95),
            "max": _at(resumed, 1),
        },
        "scene_loads": round(cluster.loads),
        "hit_rate": round(1.0 - cluster.loads / max(cluster.frames, 1.0), 4),
        "replicas_of_a_scene": {"mean": round(statistics.mean(cold), 2), "hot": calm["replicas_by_scene"].get(HOT, 0)},
        "frames_by_replica": rendered,
        "busiest_to_mean": round(max(rendered) / max(statistics.mean(rendered), 1.0), 3),
    }


def _at(ordered, share):
    return round(ordered[min(int(share * len(ordered)), len(ordered) - 1)], 1) if ordered else None
