"""Folders that helper processes make: once, whole, and the oldest go."""

import asyncio
import fcntl
import json
import os
import shutil
import subprocess
import time

import numpy as np
import pytest

from ultragray_service.core import threads
from ultragray_service.core.threads import HelperProcesses
from ultragray_service.settings import Settings
from ultragray_service.views import prepared
from ultragray_service.views.prepared import Prepared
from ultragray_workers import claims
from ultragray_workers.errors import ArtifactNotFound, DatasetNotFound, DeadlineExceeded, Draining, StorageFull
from ultragray_workers.views import lay_out

from ...file_sizes import files_of_at_most
from ...warm import WARM, Hold, warm_subprocess
from ...workers.jobs.conftest import store_dataset, tiny_dataset

DATASET = tiny_dataset()


@pytest.fixture
def wanted(tmp_path, monkeypatch):
    """A dataset `tiny` in the artifact folder, as it is asked for; helper processes are forked."""
    monkeypatch.setattr(threads, "subprocess", warm_subprocess(WARM.path()))
    store_dataset(tmp_path, "tiny")
    return {"dataset": "tiny"}


class Views(Prepared):
    name, what, fill = "views", "laying out", staticmethod(lay_out)


class Others(Views):
    name = "others"


def views(tmp_path, kind=Views, processes=None, **settings):
    chosen = Settings(data_folder=tmp_path, artifact_folder=tmp_path, **settings)
    return kind(chosen, processes or HelperProcesses(chosen.dataset_memory_mb << 20))


def names(tmp_path):
    return sorted(path.name for path in (tmp_path / "views").iterdir())


async def test_who_asks_at_the_same_time_gets_the_same_folder(tmp_path, wanted):
    made = views(tmp_path)
    found = await asyncio.gather(*(made.path("key", **wanted) for _ in range(3)))
    assert set(found) == {tmp_path / "views" / "key"}
    poses = json.loads((found[0] / "poses.json").read_text())
    np.testing.assert_allclose(np.reshape(poses["val"], (-1, 4, 4)), DATASET.val.poses, atol=1e-9)
    assert names(tmp_path) == ["key"]


def aged(tmp_path, name, age_s, size_bytes=0):
    folder = tmp_path / "views" / name
    folder.mkdir(parents=True)
    (folder / "train.npy").write_bytes(b"\0" * size_bytes)
    os.utime(folder, (time.time() - age_s,) * 2)
    return folder


@pytest.mark.parametrize(("kept_folders", "size_bytes"), [(2, 0), (32, 600)], ids=["by number", "by bytes"])
async def test_the_folder_not_asked_for_the_longest_goes(tmp_path, wanted, monkeypatch, kept_folders, size_bytes):
    monkeypatch.setattr(prepared, "KEPT_FOLDERS", kept_folders)
    aged(tmp_path, "old", 300, size_bytes)
    aged(tmp_path, "older-but-used", 200, size_bytes)
    made = views(tmp_path, max_dataset_bytes=1024)
    assert (await made.prepare("older-but-used", **wanted)).state == "ready"
    await made.path("key", **wanted)
    assert names(tmp_path) == ["key", "older-but-used"]


def test_a_service_that_dies_while_it_removes_leaves_no_half_folder(tmp_path, wanted, monkeypatch):
    monkeypatch.setattr(prepared, "KEPT_FOLDERS", 1)
    aged(tmp_path, "old", 300)
    with monkeypatch.context() as dying:
        dying.setattr(shutil, "rmtree", lambda path, ignore_errors: None)
        asyncio.run(views(tmp_path).path("key", **wanted))
    halves = [name for name in names(tmp_path) if name != "key"]
    assert halves
    assert all(name.startswith(".making-") for name in halves)
    monkeypatch.setattr(claims, "UNLOCKED_S", 0.0)
    asyncio.run(views(tmp_path).remove_stale())
    assert names(tmp_path) == ["key"]


async def test_what_fails_says_why_and_is_tried_again_later(tmp_path, wanted, monkeypatch):
    made = views(tmp_path)
    with monkeypatch.context() as slow:
        slow.setattr(prepared, "TIMEOUT_S", 0.0)
        with pytest.raises(DeadlineExceeded):
            await made.path("key", **wanted)
    failed = await made.prepare("key", **wanted)
    assert failed.state == "failed"
    assert isinstance(failed.error, DeadlineExceeded)
    with pytest.raises(DeadlineExceeded):
        await made.path("key", **wanted)
    monkeypatch.setattr(prepared, "_FAILURE_KEPT_S", 0.0)
    assert (await made.prepare("key", **wanted)).state == "running"
    await made.path("key", **wanted)
    assert names(tmp_path) == ["key"]


async def test_that_a_name_is_gone_says_nothing_of_the_content(tmp_path, wanted):
    made = views(tmp_path)
    with pytest.raises(DatasetNotFound):
        await made.path("key", dataset="gone")
    await made.path("key", **wanted)


async def test_who_waits_for_what_is_being_made_sees_its_end(tmp_path, wanted):
    made = views(tmp_path)
    with Hold("lay_out") as held:
        asking = asyncio.ensure_future(made.path("job-1", **wanted))
        while held.pid is None:
            await asyncio.sleep(0.01)
        await made.settled(lambda key: key.startswith("other-"))
        assert not (tmp_path / "views" / "job-1").exists()
    await made.settled(lambda key: key.startswith("job-"))
    assert (tmp_path / "views" / "job-1").exists()
    await asking


async def end_of(made, wanted):
    while (found := await made.prepare("key", **wanted)).state == "running":
        await asyncio.sleep(0.01)
    return found


def test_what_no_one_foresaw_is_a_failure_as_well(tmp_path, wanted, caplog):
    (tmp_path / "views").symlink_to(tmp_path / "nowhere")
    failed = asyncio.run(end_of(views(tmp_path), wanted))
    assert failed.state == "failed"
    assert failed.error.detail == "laying out failed unexpectedly, see the log"
    assert "FileExistsError" in caplog.text


def test_a_disk_without_room_is_told(tmp_path, wanted, monkeypatch):
    monkeypatch.setattr(threads, "subprocess", subprocess)  # has the limits of this process
    with files_of_at_most(DATASET.train.images.size):
        failed = asyncio.run(end_of(views(tmp_path), wanted))
    assert isinstance(failed.error, StorageFull)
    assert names(tmp_path) == []


@pytest.mark.parametrize("stop", ["end", "remove"])
def test_what_is_stopped_leaves_nothing(tmp_path, wanted, stop):
    async def ask():
        made = views(tmp_path)
        asking = asyncio.ensure_future(made.path("key", **wanted))
        while held.pid is None:
            await asyncio.sleep(0.01)
        if stop == "end":
            made.end()
            with pytest.raises(Draining):
                await made.path("key", **wanted)
        else:
            await made.forget(lambda key: True)
        with pytest.raises(Draining if stop == "end" else ArtifactNotFound):
            await asking

    with Hold("lay_out") as held:
        asyncio.run(ask())
    assert names(tmp_path) == []


def test_what_is_doomed_goes(tmp_path):
    for name in ("here", "gone", ".making-now"):
        aged(tmp_path, name, 0)
    asyncio.run(views(tmp_path).forget(lambda key: key != "here"))
    assert names(tmp_path) == [".making-now", "here"]


def test_what_dead_services_left_is_removed(tmp_path, monkeypatch):
    aged(tmp_path, "kept", 9999)
    aged(tmp_path, ".making-being-claimed", 9999)
    (aged(tmp_path, ".making-dead", 1) / "lock").touch()
    with (aged(tmp_path, ".making-alive", 9999) / "lock").open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        asyncio.run(views(tmp_path).remove_stale())
        assert names(tmp_path) == [".making-alive", ".making-being-claimed", "kept"]
        monkeypatch.setattr(claims, "UNLOCKED_S", 0.0)
        asyncio.run(views(tmp_path).remove_stale())
    assert names(tmp_path) == [".making-alive", "kept"]


async def test_one_helper_process_at_a_time(tmp_path, wanted, monkeypatch):
    started = []
    start = threads.subprocess.Popen

    def watched(*arguments, **options):
        assert all(process.returncode is not None for process in started)
        started.append(start(*arguments, **options))
        return started[-1]

    monkeypatch.setattr(threads.subprocess, "Popen", watched)
    processes = HelperProcesses(4 << 30)
    made, others = (views(tmp_path, kind, processes) for kind in (Views, Others))
    await asyncio.gather(*(each.path(key, **wanted) for each in (made, others) for key in ("a", "b")))
    assert len(started) == 4
