"""A folder that is not the one that the jobs belong to: nobody works in it, whether at the start or later."""

import pytest
import sqlalchemy as sa

from ultragray_workers.errors import ArtifactFolderUnavailable, DatabaseUnavailable, StartupFailed, StorageUnavailable
from ultragray_workers.jobs.database import KEY as FILE
from ultragray_workers.jobs.database import SQLITE_FILE, JobDatabase
from ultragray_workers.jobs.tables import WORKERS
from ultragray_workers.storage.local import LocalStorage


@pytest.fixture
def database_url(postgres):
    return postgres.create_database()


def test_another_folder_is_refused_at_the_start_and_the_id_written_there_is_believed(
    store, artifact_folder, database_url, tmp_path
):
    JobDatabase(artifact_folder, database_url).close()
    other = tmp_path / "not-mounted"
    with pytest.raises(StartupFailed, match=f"{FILE} holds no id, expected [0-9a-f]{{32}}. Mount the share") as caught:
        JobDatabase(other, database_url)
    assert caught.value.field == "artifact_folder"
    (other / FILE).write_text((artifact_folder / FILE).read_text())
    JobDatabase(other, database_url).close()
    (other / FILE).write_text("another\n")
    with pytest.raises(StartupFailed, match="holds another, expected"):
        JobDatabase(other, database_url)


def test_a_new_database_takes_the_id_of_its_folder(store, artifact_folder, postgres):
    before = (artifact_folder / FILE).read_text()
    JobDatabase(artifact_folder, postgres.create_database()).close()
    assert (artifact_folder / FILE).read_text() == before


@pytest.mark.parametrize("database_url", [None])
def test_a_database_within_the_folder_is_at_home_there(store, artifact_folder):
    before = (artifact_folder / FILE).read_text()
    (artifact_folder / FILE).unlink()
    JobDatabase(artifact_folder, None).close()
    assert (artifact_folder / FILE).read_text() == before


def test_a_storage_that_belongs_to_another_database_is_refused(artifact_folder, postgres, tmp_path):
    first, storage = postgres.create_database(), LocalStorage(tmp_path / "bucket")
    jobs = JobDatabase(artifact_folder, first, storage)
    jobs.identity.check_writable()
    assert [entry.key for entry in storage.entries()] == [FILE]
    jobs.close()
    JobDatabase(tmp_path / "another-host", first, storage).close()
    with pytest.raises(StartupFailed, match=f"{FILE} holds no id"):
        JobDatabase(artifact_folder, first, LocalStorage(tmp_path / "another-bucket"))


def test_a_storage_that_is_another_now_or_away_is_not_worked_in(artifact_folder, database_url, tmp_path, monkeypatch):
    storage = LocalStorage(tmp_path / "bucket")
    jobs = JobDatabase(artifact_folder, database_url, storage)
    storage.write(FILE, b"another")
    with pytest.raises(ArtifactFolderUnavailable, match="another bucket or prefix"):
        jobs.identity.check()

    def away(key, **_):
        raise StorageUnavailable("it does not answer")

    monkeypatch.setattr(storage, "read", away)
    with pytest.raises(ArtifactFolderUnavailable, match="does not answer"):
        jobs.identity.check()
    jobs.close()


def test_a_write_into_a_file_that_was_moved_meanwhile_says_so(tmp_path):
    """SQLite itself calls such a file read-only."""
    database = JobDatabase(tmp_path, None)
    with database.engine.connect() as connection:
        connection.execute(sa.select(WORKERS.c.name))
        (tmp_path / SQLITE_FILE).rename(tmp_path / "moved")
        with pytest.raises(DatabaseUnavailable, match="removed or replaced"):
            connection.execute(sa.insert(WORKERS).values(name="one", seen_at_s=0.0))
    database.close()
