"""A restore: over nothing unasked, under nobody's feet, and to its end however often it is interrupted."""

import hashlib
import json

import pytest
import sqlalchemy as sa

from ultragray_workers.backup import restoring
from ultragray_workers.backup.backing_up import back_up
from ultragray_workers.backup.restoring import restore
from ultragray_workers.errors import BackupInvalid, RestoreRefused, StartupFailed
from ultragray_workers.jobs import tables
from ultragray_workers.jobs.store import JobStore

from .test_backup import contents, submit


def test_nothing_is_overwritten_unasked(store, folders, backups, database_url, new_database):
    kept = submit(store, "kept")
    back_up(folders, database_url, backups)
    submit(store, "later")
    (folders.data / "later.ugr").write_bytes(b"no scene")
    with pytest.raises(RestoreRefused, match="a service or a worker is at work"):
        restore(backups, folders, database_url, overwrite=True)
    store.close()
    with pytest.raises(RestoreRefused, match=r"holds something already, such as dataset.*--force"):
        restore(backups, folders, database_url)
    restore(backups, folders, database_url, overwrite=True)
    again = JobStore(folders.artifacts, database_url)
    assert [job.id for job in again.list()[0]] == [kept.id]
    again.close()
    assert not (folders.data / "later.ugr").exists()


@pytest.mark.parametrize("kind", ["file", "link", "folder"])
def test_what_stands_in_the_way_is_named_before_anything_changes(
    kind, store, folders, backups, elsewhere, database_url
):
    back_up(folders, database_url, backups)
    elsewhere.artifacts.mkdir(parents=True)
    outside = elsewhere.data.parent / "outside"
    outside.mkdir()
    place = elsewhere.artifacts / "datasets"
    if kind == "file":
        place.write_bytes(b"")
    elif kind == "link":
        place.symlink_to(outside)
    else:
        (elsewhere.data / "demo.ugr").mkdir(parents=True)
    with pytest.raises(RestoreRefused, match="remove it first"):
        restore(backups, elsewhere, database_url, overwrite=True)
    assert not list(outside.iterdir())


def forged(backups, change):
    """Changes the only list of a folder of backups, and its hash."""
    (path,) = (backups / "manifests").glob("*.json")
    document = json.loads(path.read_text())
    del document["sha256"]
    change(document)
    sha256 = hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
    path.write_text(json.dumps({**document, "sha256": sha256}))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda document: document["files"][0].update(path="a\0b"), "names the file"),
        (lambda document: document.update(name="20200101T000000.000Z"), "calls itself '20200101T000000.000Z'"),
        (
            lambda document: document["files"].append(
                {**document["files"][0], "path": document["files"][0]["path"] + "/x"}
            ),
            "below another file",
        ),
    ],
)
def test_lists_that_no_backup_has_are_damaged(change, expected, store, folders, backups, elsewhere, database_url):
    back_up(folders, database_url, backups)
    forged(backups, change)
    with pytest.raises(BackupInvalid, match=expected):
        restore(backups, elsewhere, database_url)


def test_database_with_jobs_is_not_overwritten_by_another_folder(store, folders, backups, elsewhere, database_url):
    submit(store, "one")
    back_up(folders, database_url, backups)
    if database_url is None:  # each folder has a file of its own
        database_url = f"sqlite:///{folders.artifacts / 'jobs.sqlite'}"
    with pytest.raises(RestoreRefused, match="the database holds jobs already"):
        restore(backups, elsewhere, database_url)


@pytest.mark.long
@pytest.mark.parametrize("step", ["_write_files", "_load_database", "_let_jobs_go_on"])
def test_interrupted_restore_goes_on_and_is_seen_by_nobody_before(
    step, store, folders, backups, elsewhere, database_url, new_database, monkeypatch
):
    jobs = {submit(store, name).id for name in ("one", "two")}
    back_up(folders, database_url, backups)
    url = new_database()
    whole = getattr(restoring, step)

    def interrupted(*arguments):
        whole(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(restoring, step, interrupted)
    with pytest.raises(KeyboardInterrupt):
        restore(backups, elsewhere, url)
    monkeypatch.setattr(restoring, step, whole)
    written = (elsewhere.data / "demo.ugr").stat().st_ino
    with pytest.raises(StartupFailed, match="is being restored from a backup"):
        JobStore(elsewhere.artifacts, url)
    restore(backups, elsewhere, url)
    again = JobStore(elsewhere.artifacts, url)
    assert {job.id for job in again.list()[0]} == jobs
    again.close()
    assert (elsewhere.data / "demo.ugr").stat().st_ino == written
    for folder in ("datasets", "dataset-files"):
        assert contents(elsewhere.artifacts / folder) == contents(folders.artifacts / folder)


def test_restore_of_an_older_backup_brings_back_a_database_of_a_newer_release(
    store, database, folders, backups, database_url
):
    job = submit(store, "one")
    back_up(folders, database_url, backups)
    with database.engine.begin() as connection:
        connection.execute(sa.update(tables.SCHEMA_VERSION).values(version=99))
    store.close()
    database.close()
    with pytest.raises(StartupFailed, match="restore a backup that this one made"):
        JobStore(folders.artifacts, database_url)
    restore(backups, folders, database_url, overwrite=True)
    again = JobStore(folders.artifacts, database_url)
    assert [one.id for one in again.list()[0]] == [job.id]
    again.close()


def test_backup_of_the_other_kind_of_database_is_refused(store, folders, backups, elsewhere, database_url):
    back_up(folders, database_url, backups)
    other = "postgresql://nobody@127.0.0.1:1/none" if database_url is None else None
    with pytest.raises(RestoreRefused, match="the backup holds a database of the kind"):
        restore(backups, elsewhere, other)
