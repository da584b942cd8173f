"""An installation with a scene, a dataset and jobs, on either database."""

import pytest

from ultragray.phantom.demo import copy_demo_scene
from ultragray_workers.backup.contents import Folders
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.scenes import SceneStore

from ..jobs.conftest import store_dataset


@pytest.fixture
def database_url(new_database):
    return new_database()


@pytest.fixture
def folders(tmp_path):
    made = Folders(tmp_path / "data", tmp_path / "data" / "artifacts")
    store_dataset(made.artifacts, "tiny")
    copy_demo_scene(made.data / "demo.ugr")
    return made


@pytest.fixture
def elsewhere(tmp_path):
    """Where nothing is yet."""
    return Folders(tmp_path / "other" / "data", tmp_path / "other" / "artifacts")


@pytest.fixture
def backups(tmp_path):
    return tmp_path / "backups"


@pytest.fixture
def store(folders, database_url):
    store = JobStore(folders.artifacts, database_url, scenes=SceneStore(folders.data))
    yield store
    store.close()


@pytest.fixture
def database(folders, database_url, store):
    """The queue below the store."""
    jobs = JobDatabase(folders.artifacts, database_url)
    yield jobs
    jobs.close()
