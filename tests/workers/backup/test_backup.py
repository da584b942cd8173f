"""What a backup holds, what it copies again, and what becomes of it when it is damaged."""

import fcntl
import json

import pytest
import sqlalchemy as sa

from ultragray.samplers import AroundSampler
from ultragray_workers.backup import manifest
from ultragray_workers.backup.backing_up import back_up, verify
from ultragray_workers.backup.contents import Folders, Objects
from ultragray_workers.backup.database_copy import Database
from ultragray_workers.backup.restoring import restore
from ultragray_workers.errors import BackupInvalid, RestoreRefused
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.kinds import RenderJob
from ultragray_workers.jobs.progress import Files, JobState, StoredFile
from ultragray_workers.jobs.store import JobStore
from ultragray_workers.jobs.tables import JOBS
from ultragray_workers.scenes import SceneStore
from ultragray_workers.storage.local import LocalStorage

ODD = "tab\there, line\nbreak, back\\slash, \\N, ünï©ode 🩻, 'quotes' \"both\""


def submit(store, name):
    return store.submit(RenderJob(scene="demo", sampler=AroundSampler(2), height=16, width=16), request_id=name)[0]


def set_row(database, job, **values):
    """As the queue would."""
    with database.engine.begin() as connection:
        connection.execute(sa.update(JOBS).where(JOBS.c.id == job.id).values(**values))


def restored(backups, elsewhere, url):
    restore(backups, elsewhere, url)
    return JobStore(elsewhere.artifacts, url, scenes=SceneStore(elsewhere.data))


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_everything_comes_back_and_what_ran_waits_again(
    store, database, folders, backups, elsewhere, database_url, new_database
):
    waiting, running, done, odd = (submit(store, name) for name in ("waiting", "running", "done", ODD))
    checkpoint = StoredFile(f"jobs/{running.id}/2-1/run-1/checkpoint.safetensors", 3, "")
    LocalStorage(folders.artifacts).write(checkpoint.key, b"far")
    files = Files(run={"checkpoint.safetensors": checkpoint})
    set_row(database, running, state="running", worker="gone", attempt=1, files=files)
    set_row(database, done, state="cancelled")
    (folders.artifacts / "work" / f"{running.id}.1").mkdir(parents=True)
    (folders.artifacts / "work" / f"{running.id}.1" / "reserve").write_bytes(bytes(100))
    before, _ = store.list()

    report = back_up(folders, database_url, backups)
    assert report.manifest.counts == {"scenes": 1, "datasets": 1, "jobs": 4, "unfinished jobs": 3}
    other_url = new_database()
    other = restored(backups, elsewhere, other_url)
    after, _ = other.list()

    assert {job.id: job.state for job in after} == {
        waiting.id: JobState.QUEUED,
        running.id: JobState.QUEUED,
        done.id: JobState.CANCELLED,
        odd.id: JobState.QUEUED,
    }
    assert [job for job in after if job.id != running.id] == [job for job in before if job.id != running.id]
    assert next(job for job in after if job.id == odd.id).request_id == ODD
    for folder in ("datasets", "dataset-files", "jobs"):
        assert contents(elsewhere.artifacts / folder) == contents(folders.artifacts / folder)
    assert contents(elsewhere.artifacts / "jobs" / running.id)["2-1/run-1/checkpoint.safetensors"] == b"far"
    assert not (elsewhere.artifacts / "work").exists()
    assert (elsewhere.data / "demo.ugr").read_bytes() == (folders.data / "demo.ugr").read_bytes()
    again = queue.row_of(other.database.engine, running.id)
    assert again.files == files
    newer = submit(other, "newer")
    assert other.list()[0][0].id == newer.id
    other.close()


def test_second_backup_copies_only_what_is_new_and_old_ones_go(store, folders, backups, database_url, monkeypatch):
    submit(store, "one")
    first = back_up(folders, database_url, backups)
    assert first.new_files > 0
    gone = folders.artifacts / "scenes" / "gone.ugr"
    gone.parent.mkdir()
    gone.write_bytes(b"of the second backup alone")
    read = []
    add = Objects.add

    def noted(self, source, **options):
        read.append(source)
        return add(self, source, **options)

    monkeypatch.setattr(Objects, "add", noted)
    second = back_up(folders, database_url, backups)
    assert [path for path in read if path.is_relative_to(folders.data)] == [gone]
    assert second.new_files <= 2  # the scene, and a SQLite file that may have other bytes
    sha256 = next(entry.sha256 for entry in second.manifest.files if entry.path == "scenes/gone.ugr")
    gone.unlink()
    third = back_up(folders, database_url, backups, keep=1)
    assert manifest.names(backups) == [third.manifest.name]
    assert third.removed_backups == 2
    assert third.removed_bytes >= len(b"of the second backup alone")
    assert not Objects(backups).has(sha256)
    assert [bad for _, bad in verify(backups)] == [[]]


def test_damage_is_found_and_nothing_is_changed_by_its_restore(store, folders, backups, elsewhere, database_url):
    submit(store, "one")
    made = back_up(folders, database_url, backups).manifest
    scene = next(entry for entry in made.files if entry.path == "demo.ugr")
    path = Objects(backups).path(scene.sha256)
    damaged = bytearray(path.read_bytes())
    damaged[1000] ^= 1
    path.write_bytes(damaged)
    assert [bad for _, bad in verify(backups)] == [[scene.sha256]]
    with pytest.raises(BackupInvalid, match=r"missing or damaged, such as that of jobs/\w+/demo\.ugr"):
        restore(backups, elsewhere, database_url)
    assert not elsewhere.data.exists()
    path.unlink()
    with pytest.raises(BackupInvalid, match="missing or damaged"):
        restore(backups, elsewhere, database_url)
    text = (backups / "manifests" / f"{made.name}.json").read_text()
    (backups / "manifests" / f"{made.name}.json").write_text(text.replace("demo.ugr", "dome.ugr", 1))
    with pytest.raises(BackupInvalid, match="damaged: it does not have its own hash"):
        restore(backups, elsewhere, database_url)


def test_jobs_that_go_while_files_are_copied_are_gone_after_the_restore(
    store, database, folders, backups, elsewhere, database_url, new_database, monkeypatch
):
    stays, goes, ends = (submit(store, name) for name in ("stays", "goes", "ends"))
    set_row(database, goes, state="succeeded")
    late = []
    snapshot = Database.snapshot

    def then_they_go(self, objects, work):
        taken = snapshot(self, objects, work)
        if not late:
            store.delete(goes.id)
            store.cancel(ends.id)
            late.append(submit(store, "late"))
        return taken

    monkeypatch.setattr(Database, "snapshot", then_they_go)
    made = back_up(folders, database_url, backups).manifest
    assert (made.deleted_jobs, made.cancelled_jobs) == ((goes.id,), (ends.id,))
    other = restored(backups, elsewhere, new_database())
    states = {job.id: job.state for job in other.list()[0]}
    assert states == {stays.id: JobState.QUEUED, ends.id: JobState.CANCELLED}
    assert not (elsewhere.artifacts / "jobs" / late[0].id).exists()
    assert not (elsewhere.artifacts / "jobs" / goes.id).exists()
    other.close()


def test_backup_of_another_release_is_refused(store, folders, backups, elsewhere, database_url):
    submit(store, "one")
    made = back_up(folders, database_url, backups).manifest
    assert made.database is not None
    document = json.loads((backups / "manifests" / f"{made.name}.json").read_text())
    for change, told in (
        ({"format_version": 2}, "has version 2 of the format of backups.*restore it with release"),
        ({"database": {**document["database"], "tables_version": 99}}, "holds tables of version 99"),
    ):
        changed = {name: value for name, value in (document | change).items() if name != "sha256"}
        changed["sha256"] = manifest._sha256(changed)
        (backups / "manifests" / f"{made.name}.json").write_text(json.dumps(changed))
        with pytest.raises(BackupInvalid, match=told):
            restore(backups, elsewhere, database_url)


def test_place_that_cannot_be(folders, backups, tmp_path):
    with pytest.raises(RestoreRefused, match="lies within"):
        back_up(folders, None, folders.artifacts / "backups")
    with pytest.raises(RestoreRefused, match="must be an existing folder"):
        back_up(Folders(tmp_path / "mistyped", folders.artifacts), None, backups)
    with pytest.raises(BackupInvalid, match="holds no backup"):
        restore(backups, folders, None)
    backups.mkdir()
    with (backups / "lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(RestoreRefused, match="another backup or restore is at work"):
            back_up(folders, None, backups)
