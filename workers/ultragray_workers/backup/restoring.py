"""The way back from a backup: every hash is checked first, nothing is overwritten unasked, and a restore can go on.

From its first change to its last the artifact folder says that a restore is under way: no service and no worker opens
it, and `ultragray restore` of the same backup goes on where an earlier one was interrupted.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import sqlalchemy as sa

from ultragray.files import atomic_path, file_sha256, link_or_copy, sync
from ultragray_workers.backup import manifest as manifests
from ultragray_workers.backup.backing_up import alone_in
from ultragray_workers.backup.contents import ARTIFACTS, Folders, Objects, files_of
from ultragray_workers.backup.database_copy import Database
from ultragray_workers.backup.manifest import FileEntry, Manifest
from ultragray_workers.errors import BackupInvalid, RestoreRefused
from ultragray_workers.jobs import queue
from ultragray_workers.jobs.database import JobDatabase
from ultragray_workers.jobs.tables import WORKERS
from ultragray_workers.scene_names import SUFFIXES
from ultragray_workers.store import (
    PRIVATE_FILE,
    PRIVATE_FOLDER,
    closed_store,
    remove_restore_marker,
    restore_under_way,
    write_restore_marker,
)


def restore(
    backup_folder: Path,
    folders: Folders,
    database_url: str | None,
    *,
    name: str | None = None,
    overwrite: bool = False,
    say: Callable[[str], None] = lambda sentence: None,
) -> Manifest:
    """Makes an installation what it was at a backup (None: the newest); jobs that ran then wait again.

    `overwrite`: what the folders and the database hold now is removed where the backup does not have it. Raises
    BackupInvalid before anything is changed, RestoreRefused where there is something already or somebody at work,
    StartupFailed and OSError.
    """
    manifest = manifests.read(backup_folder, name)
    database = Database(folders.artifacts, database_url)
    if manifest.database is not None:
        database.check_loadable(manifest.database)
    say(f"checking {len(manifest.objects()):,} contents of the backup {manifest.name}")
    objects = Objects(backup_folder)
    _check_objects(manifest, objects)
    for folder in (folders.data, folders.artifacts):
        folder.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)
    _require_room(manifest, folders)
    with closed_store(folders.artifacts), alone_in(backup_folder):
        if at_work := database.workers_at_work():
            raise RestoreRefused(
                f"workers are at work in the database: {', '.join(at_work)}; stop them first", field="database_url"
            )
        if restore_under_way(folders.artifacts) != manifest.name:
            if not overwrite:
                _require_empty(folders, database)
            write_restore_marker(folders.artifacts, manifest.name)
        say(f"writing {len(manifest.files):,} files")
        _remove_others(manifest, folders, database)
        _write_files(manifest, folders, objects)
        if manifest.database is not None:
            say("loading the database")
            _load_database(manifest, database, objects)
            _let_jobs_go_on(manifest, folders.artifacts, database_url)
        remove_restore_marker(folders.artifacts)
    return manifest


def _check_objects(manifest: Manifest, objects: Objects) -> None:
    damaged = [sha256 for sha256 in manifest.objects() if not objects.is_whole(sha256)]
    if damaged:
        names = [entry.path for entry in manifest.files if entry.sha256 in damaged] or ["the database"]
        raise BackupInvalid(
            f"{len(damaged)} contents of the backup {manifest.name} are missing or damaged, such as that of "
            f"{names[0]}; nothing was restored. --backup names another backup of the folder"
        )


def _require_room(manifest: Manifest, folders: Folders) -> None:
    """Raises RestoreRefused for a file or a link where the backup has a folder, and a folder where it has a file."""
    for entry in manifest.files:
        root = folders.root(entry.root)
        target = root / entry.path
        for folder in target.parents:
            if folder == root:
                break
            if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
                raise RestoreRefused(f"{folder} must be a folder, and no link to one: remove it first")
        if target.is_dir() and not target.is_symlink():
            raise RestoreRefused(f"{target} is a folder, and a file in the backup: remove it first")


def _require_empty(folders: Folders, database: Database) -> None:
    for file in files_of(folders, database.sqlite):
        if "/" in str(file.path) or file.path.suffix in SUFFIXES:
            raise RestoreRefused(
                f"{folders.root(file.root)} holds something already, such as {file.path}: name empty folders, or give "
                "--force to replace all that is there"
            )
    if database.holds_jobs():
        raise RestoreRefused(
            "the database holds jobs already: name an empty one, or give --force to replace all that is there",
            field="database_url",
        )


def _remove_others(manifest: Manifest, folders: Folders, database: Database) -> None:
    paths = {(entry.root, entry.path) for entry in manifest.files}
    for file in list(files_of(folders, database.sqlite)):
        if (file.root, str(file.path)) not in paths:
            file.source.unlink(missing_ok=True)


def _write_files(manifest: Manifest, folders: Folders, objects: Objects) -> None:
    scenes: dict[str, Path] = {}  # by their content: those that never change are one file under several names
    written: set[Path] = set()
    for entry in manifest.files:
        target = folders.root(entry.root) / entry.path
        target.parent.mkdir(parents=True, exist_ok=True)
        if not _is_there(target, entry):
            target.unlink(missing_ok=True)
            if entry.sha256 in scenes and entry.root == ARTIFACTS:
                link_or_copy(scenes[entry.sha256], target)
            else:
                with atomic_path(target) as temporary:
                    shutil.copyfile(objects.path(entry.sha256), temporary)
                os.utime(target, ns=(entry.mtime_ns, entry.mtime_ns))
        if target.suffix in SUFFIXES and entry.root == ARTIFACTS:
            scenes.setdefault(entry.sha256, target)
        written.add(target.parent)
    for folder in written:
        sync(folder)


def _is_there(target: Path, entry: FileEntry) -> bool:
    with contextlib.suppress(OSError):
        return target.stat().st_size == entry.bytes and file_sha256(target) == entry.sha256
    return False


def _load_database(manifest: Manifest, database: Database, objects: Objects) -> None:
    assert manifest.database is not None
    if database.sqlite is None:
        database.load(manifest.database, objects)
        return
    assert manifest.database.sha256 is not None
    for companion in ("-wal", "-shm", "-journal"):  # of the file that goes
        Path(f"{database.sqlite}{companion}").unlink(missing_ok=True)
    with atomic_path(database.sqlite) as temporary:
        shutil.copyfile(objects.path(manifest.database.sha256), temporary)
        temporary.chmod(PRIVATE_FILE)


def _let_jobs_go_on(manifest: Manifest, artifact_folder: Path, database_url: str | None) -> None:
    """Lets what ran wait again, and takes away what was taken away while the backup was made."""
    jobs = JobDatabase(artifact_folder, database_url)
    try:
        with jobs.engine.begin() as connection:
            connection.execute(sa.delete(WORKERS))  # of the processes of then
        for job_id in manifest.cancelled_jobs:
            queue.cancel(jobs.engine, job_id)
        for job_id in manifest.deleted_jobs:
            queue.forget(jobs.engine, job_id)
        queue.put_back_of(jobs.engine)
    finally:
        jobs.close()
