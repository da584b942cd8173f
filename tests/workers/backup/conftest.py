"""An installation with a scene, a dataset and jobs, on either database."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from ultragray.phantom.demo import copy_demo_scene
from ultragray_workers.backup.contents import Folders
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.scenes import SceneStore

from ...postgres import NewDatabase
from ..jobs.conftest import store_dataset


@pytest.fixture
def database_url(new_database: NewDatabase) -> str | None:
    return new_database()


@pytest.fixture
def folders(tmp_path: Path) -> Folders:
    made = Folders(tmp_path / "data", tmp_path / "data" / "artifacts")
    store_dataset(made.artifacts, "tiny")
    copy_demo_scene(made.data / "demo.ugr")
    return made


@pytest.fixture
def elsewhere(tmp_path: Path) -> Folders:
    """Where nothing is yet."""
    return Folders(tmp_path / "other" / "data", tmp_path / "other" / "artifacts")


@pytest.fixture
def backups(tmp_path: Path) -> Path:
    return tmp_path / "backups"


@pytest.fixture
def store(folders: Folders, database_url: str | None) -> Iterator[JobStore]:
    store = JobStore(folders.artifacts, database_url, scenes=SceneStore(folders.data))
    yield store
    store.close()


@pytest.fixture
def database(folders: Folders, database_url: str | None, store: JobStore) -> Iterator[JobDatabase]:
    """The queue below the store."""
    jobs = JobDatabase(folders.artifacts, database_url)
    yield jobs
    jobs.close()
