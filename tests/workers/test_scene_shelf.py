"""Scenes of a bucket: named once, fetched once, served while the bucket is away, and removed."""

import hashlib
import json
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from ultragray.errors import SceneFileInvalid
from ultragray.geometry.probe import LinearProbe
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import read_header
from ultragray_workers import scene_shelf
from ultragray_workers.errors import SceneExists, SceneNotFound, StorageUnavailable
from ultragray_workers.scene_shelf import SceneShelf
from ultragray_workers.scenes import SceneStore
from ultragray_workers.storage.cache import Cache
from ultragray_workers.storage.location import open_storage

from ..waiting import wait_until

pytestmark = pytest.mark.slow
MIB = 2**20
STALE_S = 30.0


@pytest.fixture
def nothing_left_behind():
    """Instead of the one for pools: there are none here, and obstore keeps its connections."""


@pytest.fixture
def storage(new_bucket):
    return open_storage(new_bucket(), patience_s=0.5)


class Host:
    """A shelf of its own over the bucket, as each host has one."""

    def __init__(self, storage, folder, max_cache_bytes=MIB):
        self.cache = Cache(folder / "cache", max_cache_bytes, keep_s=0.1)
        self.shelf = SceneShelf(
            storage, "scenes", cache=self.cache, working_folder=folder / "work", longest_stale_s=STALE_S
        )
        self.store = SceneStore(self.shelf)


@pytest.fixture
def new_host(storage, tmp_path):
    hosts = []

    def make(**settings):
        hosts.append(Host(storage, tmp_path / f"host-{len(hosts)}", **settings))
        return hosts[-1]

    yield make
    for host in hosts:
        host.shelf.close()


def test_a_folder_keeps_the_promises_of_a_bucket(tmp_path, scene_folder):
    folder, content = tmp_path / "folder", sha256(scene_folder / "a.ugr")
    one, other = (SceneShelf(open_storage(folder), "scenes") for _ in range(2))
    with one.making() as made:
        assert other.is_making(made.name)
        (made / "new.ugr").write_bytes((scene_folder / "a.ugr").read_bytes())
        for _ in range(2):
            one.publish(made / "new.ugr", "liver")
    assert not other.is_making(made.name)
    assert other.names() == {"liver"}
    assert (other.fetch("liver"), other.sha256("liver")) == (folder / "scenes" / "liver.ugr", None)
    with pytest.raises(SceneExists, match="already a scene 'liver'"):
        other.publish(scene_folder / "b.ugr", "liver")
    storage = open_storage(folder)  # as copied from a bucket
    storage.upload(scene_folder / "a.ugr", f"scenes/objects/{content}.ugr")
    storage.write("scenes/copied.json", json.dumps({"format_version": 1, "sha256": content, "bytes": 1}).encode())
    assert one.names() == {"liver", "copied"}
    assert sha256(one.fetch("copied")) == one.sha256("copied") == content
    one.replace(scene_folder / "b.ugr", "copied")
    assert other.fetch("copied").read_bytes() == (scene_folder / "b.ugr").read_bytes()
    assert one.remove("copied")
    assert one.remove("liver")
    assert not other.remove("liver")
    assert other.names() == set()


def test_a_scene_whose_file_has_a_name_that_no_scene_can_have_is_told_of_once(tmp_path, scene_folder, caplog):
    for name in ("Übung 3.ugr", ".being-written.ugr"):
        (tmp_path / name).write_bytes((scene_folder / "a.ugr").read_bytes())
    shelf = SceneShelf(open_storage(tmp_path))
    assert [shelf.names() for _ in range(2)] == [{"a", "b"}] * 2
    (told,) = caplog.messages
    assert told.startswith("'Übung 3.ugr' in ")
    assert "is not served: scenes are served by the name of their file" in told


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_published_scene_is_that_of_every_host(new_host, scene_folder, storage):
    one, other = new_host(), new_host()
    assert other.store.names() == []
    one.shelf.publish(scene_folder / "a.ugr", "liver")
    one.shelf.publish(scene_folder / "a.ugr", "liver")  # as a job does whose worker died after the first
    content = sha256(scene_folder / "a.ugr")
    assert {entry.key for entry in storage.entries()} == {"scenes/liver.json", f"scenes/objects/{content}.ugr"}
    assert other.store.path("liver").read_bytes() == (scene_folder / "a.ugr").read_bytes()
    assert other.store.names() == ["liver"]
    with pytest.raises(SceneExists, match="already a scene 'liver'"):
        other.shelf.publish(scene_folder / "b.ugr", "liver")
    assert one.store.sha256("liver") == content


def test_a_scene_that_one_host_replaces_is_another_on_every_host(new_host, scene_folder):
    one, other = new_host(), new_host()
    one.shelf.publish(scene_folder / "a.ugr", "liver")
    version = other.store.version("liver")
    one.shelf.replace(scene_folder / "b.ugr", "liver")
    other.shelf.read()
    for host in (one, other):
        assert host.store.path("liver").read_bytes() == (scene_folder / "b.ugr").read_bytes()
        assert host.store.sha256("liver") == sha256(scene_folder / "b.ugr")
    assert other.store.version("liver") != version


def test_of_many_hosts_that_publish_at_once_one_names_the_scene(new_host, scene_folder):
    hosts = [new_host() for _ in range(6)]

    def publish(number):
        try:
            hosts[number].shelf.publish(scene_folder / "ab"[number % 2 : number % 2 + 1], "new")
        except SceneExists:
            return None
        return "ab"[number % 2]

    for name in "ab":
        os.link(scene_folder / f"{name}.ugr", scene_folder / name)
    with ThreadPoolExecutor(6) as threads:
        won = set(threads.map(publish, range(6))) - {None}
    assert len(won) == 1
    for host in hosts:
        assert host.store.path("new").read_bytes() == (scene_folder / f"{won.copy().pop()}.ugr").read_bytes()


def test_scenes_that_an_operator_copied_are_served_and_replaced(new_host, scene_folder, storage):
    storage.upload(scene_folder / "a.ugr", "scenes/liver.ugr")
    storage.write("scenes/notes.txt", b"no scene")
    storage.write("scenes/broken.json", b"{")
    host = new_host()
    assert host.store.names() == ["liver"]
    assert host.store.sha256("liver") == sha256(scene_folder / "a.ugr")
    version, header = host.store.versioned_header("liver")
    assert host.store.cached_versioned_header("liver") == (version, header)
    storage.upload(scene_folder / "b.ugr", "scenes/liver.ugr")
    host.shelf.read()
    assert host.store.cached_versioned_header("liver") is None
    assert host.store.path("liver").read_bytes() == (scene_folder / "b.ugr").read_bytes()
    assert host.store.version("liver") != version


def test_headers_are_read_without_the_gaussians(new_host, storage, random_scene, tmp_path):
    probe, poses = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0), np.tile(np.eye(4), (3, 1, 1))
    followed = replace(random_scene(20_000).info, probe=probe, tissue_shares=(0.0, 0.5, 1.0))
    beside = {"training_poses": poses, "pose_corrections": poses, "rest_poses": poses}
    GaussianScene.from_splats(random_scene(20_000).splats, info=followed, **beside).save(tmp_path / "large.ugr")
    host = new_host()
    host.shelf.publish(tmp_path / "large.ugr", "large")
    header, whole = host.store.header("large"), read_header(tmp_path / "large.ugr")
    assert header.info == whole.info
    assert header.file_bytes == whole.file_bytes
    for name in beside:
        np.testing.assert_array_equal(getattr(header, name), poses)
    assert host.cache.held_bytes() == 0
    assert host.store.header("large") is header


@pytest.mark.parametrize("content", [b"", b"short", b"\x89PNG no scene" * 20, b"\xff" * 100])
def test_an_object_that_is_no_scene_is_named(new_host, storage, content):
    storage.write("scenes/bad.ugr", content)
    with pytest.raises(SceneFileInvalid, match=r"^bad\.ugr: not a scene"):
        new_host().store.header("bad")


def test_pins_ask_for_one_content(new_host, scene_folder, storage):
    storage.upload(scene_folder / "a.ugr", "scenes/copied.ugr")
    host = new_host()
    host.shelf.publish(scene_folder / "a.ugr", "made")
    content, other = sha256(scene_folder / "a.ugr"), sha256(scene_folder / "b.ugr")
    for name in ("copied", "made"):
        for pin in (content, content[:12]):
            version, _ = host.store.versioned_header(f"{name}@{pin}")
            assert host.store.version(name) == version
            assert host.store.cached_versioned_header(f"{name}@{pin}") is not None
            assert host.store.require(f"{name}@{pin}") == name
        with pytest.raises(SceneNotFound, match=f"no longer has the content {other}; it is now {name}@{content}"):
            host.store.path(f"{name}@{other}")
        assert host.store.cached_versioned_header(f"{name}@{other}") is None
        with pytest.raises(SceneNotFound, match="there is no scene"):
            host.store.path(f"{name}@{content[:11]}")


@pytest.fixture
def asked_by(storage, monkeypatch):
    """The threads that have asked the storage for anything."""
    threads = set()

    def noted(ask):
        def note(*arguments, **options):
            threads.add(threading.current_thread())
            return ask(*arguments, **options)

        return note

    for name in ("entry", "entries_in", "read", "download"):
        monkeypatch.setattr(storage, name, noted(getattr(storage, name)))
    return threads


def test_what_is_cached_is_served_while_the_bucket_is_away(new_host, scene_folder, object_proxy, monkeypatch, asked_by):
    monkeypatch.setattr(scene_shelf, "FRESH_S", 0.1)
    monkeypatch.setattr(scene_shelf, "_OLD_S", 0.1)
    host = new_host()
    for name in ("a", "b"):
        host.shelf.publish(scene_folder / f"{name}.ugr", name)
    host.shelf.follow()
    host.store.path("a")
    object_proxy.away = True
    wait_until(lambda: host.shelf.problem is not None)
    asked_by.clear()
    for _ in range(10):  # while the list is being read, and between
        assert host.store.path("a").read_bytes() == (scene_folder / "a.ugr").read_bytes()
        assert host.store.names() == ["a", "b"]
        time.sleep(0.13)
    for read in (host.store.path, host.store.header):
        with pytest.raises(StorageUnavailable):
            read("b")
    assert asked_by
    assert threading.current_thread() not in asked_by, "nobody waits for a bucket that is known to be away"
    with pytest.raises(StorageUnavailable):
        host.store.path("perhaps-new")
    monkeypatch.setattr(host.shelf, "_longest_stale_s", 0.0)
    assert host.shelf.here("a") is None
    with pytest.raises(StorageUnavailable):
        host.store.names()
    object_proxy.away = False
    monkeypatch.setattr(host.shelf, "_longest_stale_s", STALE_S)
    wait_until(lambda: host.shelf.problem is None)
    assert host.store.path("b").read_bytes() == (scene_folder / "b.ugr").read_bytes()


def test_a_scene_that_is_held_stays_and_others_leave_the_cache(new_host, scene_folder):
    size = (scene_folder / "a.ugr").stat().st_size
    host = new_host(max_cache_bytes=2 * size + 100)
    for number, name in enumerate(("one", "two", "three")):
        path = scene_folder / f"{name}.bytes"
        path.write_bytes((scene_folder / "a.ugr").read_bytes() + bytes([number]))
        host.shelf.publish(path, name)
    first = host.store.path("one")
    with host.store.hold("one") as held:
        assert held == first
        for name in ("two", "three", "two", "three"):
            host.store.path(name)
            assert host.cache.held_bytes() <= host.cache.max_bytes
            assert first.exists()
    time.sleep(0.1)
    host.store.path("two")
    host.store.path("three")
    assert not first.exists()


def test_a_removed_scene_is_gone_everywhere_and_its_object_later(new_host, scene_folder, storage, monkeypatch):
    one, other = new_host(), new_host()
    for name in ("a", "again"):
        one.shelf.publish(scene_folder / "a.ugr", name)
    one.shelf.publish(scene_folder / "b.ugr", "b")
    assert other.store.names() == ["a", "again", "b"]
    assert one.shelf.remove("b")
    assert not one.shelf.remove("b")
    assert one.store.names() == ["a", "again"]
    other.shelf.read()
    assert other.store.names() == ["a", "again"]
    with pytest.raises(SceneNotFound):
        other.store.path("b")
    assert one.shelf.remove_unused() == 0  # too young
    time.sleep(1.1)  # the bucket tells whole seconds
    assert one.shelf.remove_unused(0.0) == 1
    keys = {entry.key for entry in storage.entries()}
    assert keys == {"scenes/a.json", "scenes/again.json", f"scenes/objects/{sha256(scene_folder / 'a.ugr')}.ugr"}
    monkeypatch.setattr(scene_shelf, "UNUSED_AFTER_S", 0.0)
    one.shelf.publish(scene_folder / "b.ugr", "b")
    assert other.store.path("b").read_bytes() == (scene_folder / "b.ugr").read_bytes()


def test_an_index_of_a_newer_release_is_left_alone(new_host, storage):
    storage.write("scenes/new.json", json.dumps({"format_version": 2, "sha256": "0" * 64, "bytes": 1}).encode())
    assert new_host().store.names() == []


def test_who_makes_a_scene_is_seen_by_other_hosts(new_host):
    one, other = new_host(), new_host()
    with one.shelf.making() as folder:
        assert other.shelf.is_making(folder.name)
    assert not other.shelf.is_making(folder.name)
