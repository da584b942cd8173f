"""Batches on a real Ray cluster of this machine."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from ultragray.errors import BackendUnavailable, InvalidArgument
from ultragray.exchange.batches import names_in
from ultragray.exchange.shards import ShardRenderer
from ultragray_workers.batches import on_ray
from ultragray_workers.batches.on_ray import RayBatch

from ...waiting import wait_until
from .conftest import plan_of

pytest.importorskip("ray", reason="Ray is not installed: pip install 'ultragray[ray]'")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # of Ray's own


def shard_processes():
    """The processes of the cluster that make shards."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if (folder / "cmdline").read_bytes().startswith(b"ray::ultragray shard"):
                found.append(int(folder.name))
        except OSError:
            continue
    return found


def test_files_are_those_of_one_process_though_a_worker_is_killed_and_made_once(scene_file, tmp_path):
    plan = plan_of(scene_file, 20_000, 1_000)
    killed = []
    told = []

    def report(frames):
        told.append(frames)
        if frames and not killed and (found := shard_processes()):
            killed.append(found[0])
            os.kill(found[0], signal.SIGKILL)

    folder = tmp_path / "made"
    RayBatch(plan, scene_file, str(folder)).render("ray", report)
    assert killed
    assert told == sorted(told)
    assert told[-1] == 20_000
    made = {path.name: path for path in folder.iterdir()}
    assert sorted(made) == [*names_in(plan.file_names), "manifest.json"]
    renderer = ShardRenderer(plan, scene_file, torch.device("cpu"))
    for shard in (0, 7, 19):
        renderer.render(shard, tmp_path / "shard.tar")
        assert (tmp_path / "shard.tar").read_bytes() == made[plan.file_name(shard)].read_bytes()

    before = {name: path.stat().st_mtime_ns for name, path in made.items()}
    RayBatch(plan, scene_file, str(folder)).render("ray", told.append)  # needs no cluster
    assert {name: path.stat().st_mtime_ns for name, path in made.items()} == before
    with pytest.raises(InvalidArgument, match=r"manifest\.json of another batch"):
        RayBatch(plan_of(scene_file, 20_001, 1_000), scene_file, str(folder)).render("ray", told.append)


def test_a_release_of_the_cluster_that_differs_is_told(scene_file, tmp_path, monkeypatch):
    monkeypatch.setattr(on_ray.ultragray, "__version__", "99.0")
    with pytest.raises(Exception, match=r"shard 0: the Ray cluster has ultragray .*, this is 99\.0"):
        RayBatch(plan_of(scene_file, 20, 20), scene_file, str(tmp_path / "made")).render("ray", lambda frames: None)


@pytest.fixture
def head(tmp_path):
    """The address of a cluster that runs by itself, as others' clusters do."""
    with contextlib.ExitStack() as held:
        free = [held.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(2)]
        port, client_port = (one.getsockname()[1] for one in free)
    command = [str(Path(sys.executable).with_name("ray")), "start", "--head", "--block", "--include-dashboard=false"]
    ports = [f"--port={port}", f"--ray-client-server-port={client_port}", "--node-ip-address=127.0.0.1"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with (tmp_path / "ray.log").open("wb") as log:
        process = subprocess.Popen([*command, *ports, "--num-cpus=2"], stdout=log, stderr=log, env=environment)
    try:
        wait_until(lambda: _answers(client_port), within_s=120)
        yield f"ray://127.0.0.1:{client_port}"
    finally:
        process.terminate()
        process.wait(300)


def _answers(port):
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
        return True
    return False


@pytest.mark.long
def test_a_cluster_of_others_is_reached_by_its_address_and_goes_on_after_the_batch(head, scene_file, tmp_path):
    for number in (1, 2):
        plan = plan_of(scene_file, 400, 100)
        folder = tmp_path / f"made{number}"
        told = []
        RayBatch(plan, scene_file, str(folder)).render(head, told.append)
        assert told[-1] == 400
        ShardRenderer(plan, scene_file, torch.device("cpu")).render(3, tmp_path / "shard.tar")
        assert (tmp_path / "shard.tar").read_bytes() == (folder / plan.file_name(3)).read_bytes()


def test_a_cluster_that_is_not_there_is_told_in_one_sentence(scene_file, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(BackendUnavailable, match=f"the Ray cluster ray://127.0.0.1:{port} cannot be used"):
        RayBatch(plan_of(scene_file, 20, 20), scene_file, str(tmp_path / "made")).render(
            f"ray://127.0.0.1:{port}", lambda frames: None
        )
