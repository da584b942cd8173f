"""A batch in 200 shards on workers that are killed at random, and on Ray: exactly the seeded frames, each once.

ULTRAGRAY_SHARDS_FRAMES says how many frames (make test-shards FRAMES=1000000), ULTRAGRAY_SHARDS_RECORD where the
figures go. In the first half of the frames nobody is killed: there the rate is measured.
"""

import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tarfile
import threading
import time
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from ultragray import render
from ultragray.exchange.batches import BatchPlan, names_in
from ultragray.files import file_sha256, write_whole
from ultragray.phantom.demo import copy_demo_scene
from ultragray.rendering.settings import FrameSettings
from ultragray.samplers import AroundSampler
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import read_header
from ultragray_studies.bench.report import measured
from ultragray_workers.jobs.kinds import RenderJob
from ultragray_workers.jobs.progress import JobState
from ultragray_workers.jobs.store import JobStore

from ..surroundings import ROOT
from ..waiting import Deadline
from ..workers.jobs.conftest import FINAL, RunningWorker

pytestmark = pytest.mark.long

FRAMES = int(os.environ.get("ULTRAGRAY_SHARDS_FRAMES", "20000"))
RECORD = os.environ.get("ULTRAGRAY_SHARDS_RECORD")
SHARDS = max(8, min(200, FRAMES // 1_000))  # small ones would show what a shard costs, not a frame
SIDE, SEED = 64, 2026
WORKERS = os.cpu_count() or 1
KILL_EVERY_S = (10.0, 30.0)
CHECKED = 500  # frames that are rendered once more
KERNEL_S = 10.0
LEAST_SHARE = 0.9  # of workers × kernel rate
LARGE = 500_000  # frames: below, starting is a part of what is measured, and the share is only told
TIMEOUT_S = 120.0 + FRAMES / 20.0
KERNEL_PROGRAM = """
import sys, time, torch
from ultragray import GaussianScene, render
from ultragray.samplers import AroundSampler
torch.set_num_threads(1)
scene, side, seconds = GaussianScene.load(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
poses = AroundSampler(2_000).poses(scene.training_poses, scene.info.probe)
print("ready", flush=True)
sys.stdin.readline()
done, started = 0, time.perf_counter()
with torch.no_grad():
    while (passed := time.perf_counter() - started) < seconds:
        first = done % (len(poses) - 32)
        render(scene, None, poses[first : first + 32], height=side, width=side, outputs=("bmode",))
        done += 32
print(done / passed)
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("batch")
    (folder / "artifacts" / "scenes").mkdir(parents=True)
    copy_demo_scene(folder / "artifacts" / "scenes" / "spine.ugr")
    return folder


@pytest.fixture(scope="module")
def figures(place):
    """What is measured; recorded at the end."""
    found = {
        "measured": measured(1),
        "extent": {"frames": FRAMES, "shards": SHARDS, "side": SIDE, "workers": WORKERS},
        "kernel_frames_per_s": kernel_rate(scene_of(place)),
    }
    yield found
    found.pop("hashes", None)
    if RECORD is not None and "queue" in found:
        found["kernel_frames_per_s"] = 0.5 * (found["kernel_frames_per_s"] + kernel_rate(scene_of(place)))
        for engine in ("queue", "ray"):
            if engine in found:
                found[engine]["share_of_kernel"] = found[engine]["frames_per_s"] / found["kernel_frames_per_s"]
        write_whole(ROOT / RECORD, json.dumps(found, indent=1) + "\n")


def scene_of(place):
    return place / "artifacts" / "scenes" / "spine.ugr"


def plan_of(scene):
    return BatchPlan.prepared(
        read_header(scene),
        FrameSettings(height=SIDE, width=SIDE),
        sampler=AroundSampler(FRAMES, seed=SEED),
        poses=None,
        shard_frames=-(-FRAMES // SHARDS),
        scene="spine",
        scene_sha256=file_sha256(scene),
    )


def kernel_rate(scene):
    """Frames a second of the kernel alone, one process of one thread for each worker, all at the same time."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    command = [sys.executable, "-c", KERNEL_PROGRAM, str(scene), str(SIDE), str(KERNEL_S)]
    running = [
        subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(WORKERS)
    ]
    for process in running:  # each has loaded its scene
        assert process.stdout.readline() == "ready\n"
    return sum(float(process.communicate()[0]) for process in _started(running))


def _started(processes):
    for process in processes:
        process.stdin.write("go\n")
        process.stdin.flush()
    return processes


def check_frames(folder, scene):
    """The hashes of the files by name, once they are exactly the frames of the plan, each once."""
    plan = plan_of(scene)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["plan"] == plan.identity
    hashes = {shard["file"]: shard["sha256"] for shard in manifest["shards"]}
    assert list(hashes) == list(names_in(plan.file_names))
    loaded = GaussianScene.load(scene)
    chosen = set(np.random.default_rng(SEED).choice(FRAMES, min(CHECKED, FRAMES), replace=False).tolist())
    sampler = AroundSampler(FRAMES, seed=SEED)
    probe = loaded.info.probe_or(None)
    number = 0
    for file, sha256 in hashes.items():
        data = (folder / file).read_bytes()
        assert hashlib.sha256(data).hexdigest() == sha256
        with tarfile.open(fileobj=BytesIO(data)) as tar:
            for name in tar.getnames()[::2]:
                assert name == f"{plan.key(number)}.bmode.npy"
                if number in chosen:
                    member = tar.extractfile(name)
                    assert member is not None
                    block = sampler.block(number // 5_000)
                    pose = block.poses(loaded.training_poses, probe)[number % 5_000]
                    frame = render(loaded, None, pose, height=SIDE, width=SIDE, outputs=("bmode",))["bmode"].numpy()
                    np.testing.assert_array_equal(np.load(BytesIO(member.read())), np.rint(frame[0] * 255))
                number += 1
    assert number == FRAMES
    return hashes


class Killer:
    """Kills workers and the processes of their jobs at random, and starts workers again."""

    def __init__(self, start):
        self._start, self._random = start, random.Random(SEED)
        self.workers = {f"host-{number}": start(f"host-{number}") for number in range(WORKERS)}
        self.kills = 0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def begin(self):
        self._thread.start()

    def end(self):
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join()
        for worker in self.workers.values():
            worker.kill()

    def _run(self):
        while True:
            name = self._random.choice(sorted(self.workers))
            process = self.workers[name].job_process()
            if self._random.random() < 0.5 and process is not None:
                os.kill(process, signal.SIGKILL)
            else:
                self.workers[name].kill()
                self.workers[name] = self._start(name)
            self.kills += 1
            if self._over.wait(self._random.uniform(*KILL_EVERY_S)):
                return


def until(store, job_id, reached):
    end = Deadline(TIMEOUT_S)
    while not reached(job := store.get(job_id)) and job.state not in FINAL:
        assert not end.passed, (job, store.log_tail(job_id))
        time.sleep(0.1)
    return job


def test_the_queue_makes_each_frame_once_though_workers_are_killed(place, figures):
    artifacts = place / "artifacts"
    store = JobStore(artifacts, os.environ.get("DATABASE_URL"))
    job = RenderJob(
        scene="spine",
        sampler=AroundSampler(FRAMES, seed=SEED),
        shard_frames=-(-FRAMES // SHARDS),
        height=SIDE,
        width=SIDE,
    )
    killer = Killer(lambda name: RunningWorker(artifacts, None, name, place / f"{name}.log", {"host": name}))
    try:
        submitted, _ = store.submit(job)

        def done(one):
            return one.progress.frames_done or 0

        first = until(store, submitted.id, lambda one: done(one) >= 0.1 * FRAMES)
        began_s, before = time.monotonic(), done(first)
        half = until(store, submitted.id, lambda one: done(one) >= 0.5 * FRAMES)
        rate = (done(half) - before) / (time.monotonic() - began_s)
        killer.begin()
        finished = until(store, submitted.id, lambda one: one.state in FINAL)
        assert finished.state is JobState.SUCCEEDED, finished
    finally:
        killer.end()
        store.close()
    assert killer.kills > 0
    folder = artifacts / "jobs" / finished.id / "batch"
    figures["hashes"] = check_frames(folder, scene_of(place))
    figures["queue"] = {"frames_per_s": rate, "kills": killer.kills, "attempts": finished.attempts}
    share = rate / figures["kernel_frames_per_s"]
    if FRAMES >= LARGE:
        assert share >= LEAST_SHARE


def test_ray_makes_the_same_files_though_a_worker_is_killed(place, figures):
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'ultragray[ray]'")
    from ultragray_workers.batches.on_ray import RayBatch

    told = []
    killed = []

    def report(frames):
        told.append((time.monotonic(), frames))
        if frames >= 0.5 * FRAMES and not killed:
            killed.append(ray_worker())
            os.kill(killed[0], signal.SIGKILL)

    scene = scene_of(place)
    RayBatch(plan_of(scene), scene, str(place / "ray")).render("ray", report)
    assert killed
    hashes = check_frames(place / "ray", scene)
    (began_s, before), (ended_s, after) = (
        next(one for one in told if one[1] >= share * FRAMES) for share in (0.1, 0.5)
    )
    figures["ray"] = {"frames_per_s": (after - before) / (ended_s - began_s), "kills": len(killed)}
    assert hashes == figures.get("hashes", hashes)


def ray_worker():
    """A process of the cluster that makes a shard."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if (folder / "cmdline").read_bytes().startswith(b"ray::ultragray shard"):
                return int(folder.name)
        except OSError:
            continue
    raise AssertionError("no worker of Ray makes a shard")
