"""Copies of the scenes of an installation: whole, compared, resumable, and never over something else."""

import json

import pytest

from ultragray_workers.backup.copying import Copied, CopiedDatasets, copy_datasets, copy_scenes
from ultragray_workers.datasets.store import DatasetStore
from ultragray_workers.errors import RestoreRefused
from ultragray_workers.storage.local import LocalStorage

from ..jobs.conftest import store_dataset

SCENES = ("demo.ugr", "artifacts/scenes/made.ugr")
OTHERS = ("notes.txt", "artifacts/jobs.sqlite", "artifacts/scenes/.importing-1/x.ugr", "artifacts/jobs/0/made.ugr")


@pytest.fixture
def installation(tmp_path):
    found = LocalStorage(tmp_path / "installation")
    for key in (*SCENES, *OTHERS):
        found.write(key, key.encode())
    return found


def test_scenes_are_copied_and_a_second_copy_finds_them(storage, installation):
    assert copy_scenes(installation, storage) == Copied(2, sum(map(len, SCENES)), 0)
    assert {entry.key for entry in storage.entries()} == set(SCENES)
    assert storage.read("artifacts/scenes/made.ugr") == b"artifacts/scenes/made.ugr"
    storage.delete("demo.ugr")
    assert copy_scenes(installation, storage) == Copied(1, len("demo.ugr"), 1)


def test_another_scene_of_that_name_stays(storage, installation):
    storage.write("demo.ugr", b"another")
    with pytest.raises(RestoreRefused, match=r"has another demo\.ugr"):
        copy_scenes(installation, storage)
    assert storage.read("demo.ugr") == b"another"


def test_scenes_of_a_bucket_go_back_into_a_folder(storage, installation, tmp_path):
    installation.write("scenes/new.json", b"{}")
    installation.write("scenes/objects/0123.ugr", b"object")
    copy_scenes(installation, storage)
    back = LocalStorage(tmp_path / "back")
    said = []
    assert copy_scenes(storage, back, said.append).scenes == 4
    assert said[-1].endswith("scenes/new.json copied")  # after the object that it names
    assert back.read("scenes/objects/0123.ugr") == b"object"


@pytest.fixture
def artifacts(tmp_path):
    for name in ("one", "two"):
        store_dataset(tmp_path / "artifacts", name)
    return tmp_path / "artifacts"


def test_datasets_are_copied_once_and_read_as_they_were(artifacts, tmp_path):
    bucket = LocalStorage(tmp_path / "bucket")
    said = []
    assert copy_datasets(LocalStorage(artifacts), bucket, said.append) == CopiedDatasets(2, 0)
    assert said == ["1 of 2: dataset one copied", "2 of 2: dataset two copied"]
    copies = DatasetStore(tmp_path / "host", bucket)
    assert copies.names() == ["one", "two"]
    assert copies.get("two") == DatasetStore(artifacts).get("two")
    assert copies.load("two").sha256 == DatasetStore(artifacts).load("two").sha256
    copies.delete("one")
    assert copy_datasets(LocalStorage(artifacts), bucket) == CopiedDatasets(1, 1)


def test_another_dataset_of_that_name_stays(artifacts, tmp_path):
    bucket = LocalStorage(tmp_path / "bucket")
    copy_datasets(LocalStorage(artifacts), bucket)
    manifest = artifacts / "datasets" / "one.json"
    manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "sha256": "0" * 64}))
    with pytest.raises(RestoreRefused, match="has another dataset 'one'"):
        copy_datasets(LocalStorage(artifacts), bucket)
    assert DatasetStore(tmp_path / "host", bucket).get("one").sha256 != "0" * 64
