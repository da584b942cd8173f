"""Copies of the scenes of an installation: whole, compared, resumable, and never over something else."""

import pytest

from ultragray_workers.backup.copying import Copied, copy_scenes
from ultragray_workers.errors import RestoreRefused
from ultragray_workers.storage.local import LocalStorage

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
