"""Scenes in a worker's memory."""

import shutil
from typing import get_args

import pytest
import torch

from ultragray import GaussianScene
from ultragray.errors import MemoryExceeded, SceneFileInvalid
from ultragray.files import file_sha256
from ultragray.geometry.probe import Lines
from ultragray_workers import SceneStore
from ultragray_workers.errors import SceneTooLarge
from ultragray_workers.pool import worker as scene_cache
from ultragray_workers.pool.worker import SceneCache, example_probes
from ultragray_workers.scenes import resident_bytes

CPU = torch.device("cpu")


@pytest.fixture
def scene_bytes(scene_folder):
    return resident_bytes(SceneStore(scene_folder).header("a").info)


def test_the_least_recently_used_scene_makes_room(scene_folder, scene_bytes):
    shutil.copy(scene_folder / "a.ugr", scene_folder / "c.ugr")
    cache = SceneCache(2 * scene_bytes, CPU)
    path = {name: str(scene_folder / f"{name}.ugr") for name in "abc"}
    first = cache.get("a", path["a"])
    cache.get("b", path["b"])
    assert cache.get("a", path["a"]) is first  # used: b is the oldest now
    cache.get("c", path["c"])
    assert cache.names() == ("a", "c")


def test_a_scene_larger_than_the_budget_evicts_nothing(scene_folder, scene_bytes, random_scene):
    random_scene(100).save(scene_folder / "large.ugr")
    cache = SceneCache(scene_bytes, CPU)
    cache.get("a", str(scene_folder / "a.ugr"))
    with pytest.raises(SceneTooLarge, match="'large'"):
        cache.get("large", str(scene_folder / "large.ugr"))
    assert cache.names() == ("a",)


def test_hash_and_tensors_are_of_the_same_bytes(scene_folder, monkeypatch):
    """The file is replaced after its tensors are read, before its hash is."""
    path = scene_folder / "a.ugr"
    new = GaussianScene.load(scene_folder / "b.ugr")

    def hash_a_file_that_just_changed(name):
        if (scene_folder / "b.ugr").exists():
            (scene_folder / "b.ugr").replace(path)
        return file_sha256(name)

    monkeypatch.setattr(scene_cache, "file_sha256", hash_a_file_that_just_changed)
    loaded = SceneCache(10**9, CPU).get("a", str(path))
    assert loaded.sha256 == file_sha256(path)
    assert torch.equal(loaded.scene.means, new.means)


def test_a_file_that_vanished_is_dropped(scene_folder):
    cache = SceneCache(10**9, CPU)
    cache.get("a", str(scene_folder / "a.ugr"))
    (scene_folder / "a.ugr").unlink()
    with pytest.raises(SceneFileInvalid, match="no such file"):
        cache.get("a", str(scene_folder / "a.ugr"))
    assert cache.names() == ()


def test_scenes_lie_on_the_device(scene_folder):
    loaded = SceneCache(10**9, torch.device("meta")).get("a", str(scene_folder / "a.ugr"))
    assert {tensor.device.type for tensor in loaded.scene.splats.values()} == {"meta"}


def test_a_device_without_room_is_an_error_and_keeps_what_it_holds(scene_folder, monkeypatch):
    cache = SceneCache(10**9, CPU)
    cache.get("a", str(scene_folder / "a.ugr"))

    def no_room(scene, target):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(GaussianScene, "to", no_room)
    with pytest.raises(MemoryExceeded, match=r"scene 'b' of 0\.0 MiB"):
        cache.get("b", str(scene_folder / "b.ugr"))
    assert cache.names() == ("a",)


def test_every_bundle_of_scan_lines_is_warmed_up():
    assert {type(probe.lines) for probe in example_probes()} == set(get_args(Lines))
