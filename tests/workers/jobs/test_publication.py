from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest
from ultragray_workers.jobs.publication import give_name_back, publish_scene

from ultragray_workers.errors import SceneExists
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.owners import Kind, read_owner
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.storage.local import LocalStorage

from .conftest import train_job


@pytest.fixture(params=["links", "no links"])
def folder(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> JobFolder:
    """Of a job that made the scene `new`."""
    if request.param == "no links":

        def refuse(*arguments: Any) -> None:
            raise OSError(errno.EPERM, "no links here")

        monkeypatch.setattr(os, "link", refuse)
    folder = JobFolder(tmp_path, "0" * 24)
    folder.artifacts.mkdir(parents=True)
    (folder.artifacts / "new.ugr").write_bytes(b"scene")
    return folder


def test_a_scene_is_served_once_and_whole(folder: JobFolder) -> None:
    for _ in range(2):
        publish_scene(folder, "new")
    served = folder.artifact_folder / "scenes"
    assert [path.name for path in served.iterdir()] == ["new.ugr"]
    assert (served / "new.ugr").read_bytes() == b"scene"


def test_another_scene_of_that_name_stays(folder: JobFolder) -> None:
    served = folder.artifact_folder / "scenes" / "new.ugr"
    served.parent.mkdir()
    served.write_bytes(b"another")
    with pytest.raises(SceneExists, match="appeared"):
        publish_scene(folder, "new")
    assert served.read_bytes() == b"another"
    assert [path.name for path in served.parent.iterdir()] == ["new.ugr"]


def test_a_scene_of_a_shared_storage_is_named_there_alone(folder: JobFolder, tmp_path: Path) -> None:
    shared = LocalStorage(tmp_path / "shared")
    for _ in range(2):
        publish_scene(folder, "new", shared)
    assert {entry.key.partition("/objects/")[0] for entry in shared.entries()} == {"scenes", "scenes/new.json"}
    assert not (folder.artifact_folder / "scenes").exists()
    (folder.artifacts / "new.ugr").write_bytes(b"another")
    with pytest.raises(SceneExists, match="appeared"):
        publish_scene(folder, "new", shared)


@pytest.mark.parametrize("is_served", [False, True])
def test_a_job_that_ends_without_its_scene_gives_the_name_back(
    jobs: JobDatabase, store: JobStore, artifact_folder: Path, is_served: bool
) -> None:
    def owner() -> str | None:
        with jobs.engine.connect() as connection:
            return read_owner(connection, Kind.SCENE, "made").owner

    job, _ = store.submit(train_job("made"), owner="alice")
    folder = JobFolder(artifact_folder, job.id)
    folder.artifacts.mkdir(parents=True)
    (folder.artifacts / "made.ugr").write_bytes(b"made")
    assert owner() == "alice"
    if is_served:
        publish_scene(folder, "made")
    give_name_back(jobs, folder, "made", "bob")
    assert owner() == "alice"
    give_name_back(jobs, folder, "made", "alice")
    assert owner() == ("alice" if is_served else None)
