from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from ultragray_workers.errors import SceneExists
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.publication import publish_scene


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
