"""Commands of who looks after an installation: keys, audit, backup, restore, storage."""

from __future__ import annotations

import json as json_text
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, astuple
from datetime import datetime, timezone
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.errors import InvalidArgument
from ultragray_service.access.principals import NAMES, Role, read_limits
from ultragray_service.cli.options import FieldsOf, with_options
from ultragray_service.cli.terminal import (
    Columns,
    Json,
    argument,
    command_group,
    examples,
    option,
    single,
    tell,
    tell_table,
    to_json,
)
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings, load_settings
from ultragray_workers.errors import BackupInvalid

if TYPE_CHECKING:
    from ultragray_service.access.keys import Key, KeyStore
    from ultragray_workers.backup.contents import Folders
    from ultragray_workers.backup.manifest import Manifest
    from ultragray_workers.jobs.database import JobDatabase


Where = Annotated[
    dict[str, Any], FieldsOf(Settings, "data_folder", "artifact_folder", "database_url", environment=ENVIRONMENT_PREFIX)
]


@contextmanager
def opened_database(where: dict[str, Any]) -> Iterator[JobDatabase]:
    """The database that the options name. Raises InvalidArgument where there is no such installation, StartupFailed."""
    from ultragray_workers.jobs.database import JobDatabase
    from ultragray_workers.storage.location import open_storage

    settings = load_settings(**where)
    if settings.database_url is None and not settings.is_there:
        raise InvalidArgument(
            f"data_folder must be an existing folder, got {str(settings.data_folder)!r}: name that of the service with "
            "--data-folder",
            field="data_folder",
        )
    database = JobDatabase(settings.working_folder, settings.database_url, open_storage(settings.artifacts))
    try:
        yield database
    finally:
        database.close()


keys_app = command_group("They live in the installation's database; changes count within two seconds.")

_KEY_COLUMNS: Columns = {
    **{name: itemgetter(name) for name in ("id", "name")},
    "role": lambda key: str(key["role"].value),
    "state": itemgetter("state"),
    "created": lambda key: _time(key["created_at_s"], ""),
    "expires": lambda key: _time(key["expires_at_s"], "never"),
    "last used": lambda key: _time(key["last_used_at_s"], "never"),
    "limits": lambda key: " ".join(
        f"{name}={'none' if value is None else f'{value:g}'}" for name, value in key["limits"].items()
    ),
}


@keys_app.command(
    epilog=examples(
        "ultragray keys create alice --role operator --expires-days 90",
        "ultragray keys create console --role reader --limit frames_per_s=60",
    )
)
@with_options
def create(
    name: Annotated[str, argument("Whose it is: a person, a machine or a program.")],
    *,
    role: Annotated[
        Role, option("reader: sees, renders, streams; operator: and has jobs, datasets and scenes; admin: everything.")
    ],
    expires_days: Annotated[
        float | None, option("Days that it counts.", min=0.0, max=36500.0, shown="for ever")
    ] = None,
    limit: Annotated[
        list[str] | None,
        option(
            f"A limit of its own, NAME=none: no limit; may be repeated. Names: {', '.join(NAMES)}.",
            metavar="NAME=NUMBER",
            shown="the settings key_NAME of the service",
        ),
    ] = None,
    json: Json = False,
    where: Where,
) -> None:
    """Make a key, and print it: alone on standard output, and never again."""
    limits = read_limits(limit or ())
    settings = load_settings(**where)
    default = Settings().data_folder
    if settings.database_url is None and settings.data_folder == default and isinstance(default, Path):
        default.mkdir(exist_ok=True)  # as `serve` makes it: keys may come first
    with _key_store(where) as store:
        others = [key for key in store.keys().values() if key.name == name and key.is_valid(time.time())]
        key, secret = store.create(name, role, expires_days, limits)
    typer.echo(f"key {key.id} of {key.name}, {key.role.value}, expires: {_time(key.expires_at_s, 'never')}", err=True)
    for other in others:
        typer.echo(f"{name} still has the key {other.id}, {other.role.value}, too", err=True)
    typer.echo("Keep it now: it is shown only once.", err=True)
    tell(secret, {**_document(key), "secret": secret}, as_json=json)


@keys_app.command("list", epilog=examples("ultragray keys list", "ultragray keys list --json"))
@with_options
def list_keys(*, json: Json = False, where: Where) -> None:
    """List the keys, oldest first, also those that count no more; no secrets."""
    with _key_store(where) as store:
        tell_table(_KEY_COLUMNS, [_document(key) for key in store.keys().values()], as_json=json)


@keys_app.command(epilog=examples("ultragray keys revoke alice"))
@with_options
def revoke(name: Annotated[str, argument("Name, or id of one key.")], *, json: Json = False, where: Where) -> None:
    """Revoke all keys of a name, or the one of an id. What runs on them is cut within two seconds."""
    with _key_store(where) as store:
        revoked = store.revoke(name)
    lines = [f"revoked {key.id} of {key.name}, {key.role.value}" for key in revoked]
    if lines or json:
        tell("\n".join(lines), [_document(key) for key in revoked], as_json=json)
    if not revoked:
        typer.echo(f"nothing changed: every key of {name} was revoked already, or has expired", err=True)


@contextmanager
def _key_store(where: dict[str, Any]) -> Iterator[KeyStore]:
    from ultragray_service.access.keys import KeyStore

    with opened_database(where) as database:
        yield KeyStore(database.engine)


def _document(key: Key) -> dict[str, Any]:
    expired = "valid" if key.is_valid(time.time()) else "expired"
    return {**asdict(key), "state": expired if key.revoked_at_s is None else "revoked"}


def _time(at_s: float | None, otherwise: str) -> str:
    if at_s is None:
        return otherwise
    return datetime.fromtimestamp(at_s, timezone.utc).isoformat(sep=" ", timespec="minutes")


_AUDIT_COLUMNS: Columns = {
    **{name: itemgetter(name) for name in ("time", "who", "address", "what", "target", "result")},
    "facts": lambda entry: json_text.dumps(entry["facts"]),
}
_HOUR_S = 3600.0


@single("ultragray audit --since-hours 168 --who console", "ultragray audit --what scene.delete --json")
@with_options
def audit(
    *,
    since_hours: Annotated[float, option("How far back.", min=0.0)] = 24.0,
    who: Annotated[str | None, option("Only of this name.", shown="all")] = None,
    what: Annotated[str | None, option("Only this operation, such as scene.delete, or scene.", shown="all")] = None,
    limit: Annotated[int, option("The last ones, at most.", min=1)] = 1000,
    json: Json = False,
    where: Where,
) -> None:
    """Oldest first. What is not given here comes from the settings (ULTRAGRAY_…)."""
    from ultragray_service.access.audit import read_audit

    since_s = time.time() - since_hours * _HOUR_S
    with opened_database(where) as database:
        entries = read_audit(database.engine, since_s=since_s, who=who, what=what, limit=limit)
    documents = [{**asdict(entry), "time": _timestamp(entry.at_s)} for entry in entries]
    tell_table(_AUDIT_COLUMNS, documents, as_json=json)


def _timestamp(at_s: float) -> str:
    return datetime.fromtimestamp(at_s, timezone.utc).isoformat(timespec="milliseconds")


BackupFolder = Annotated[Path, argument("Folder of backups, on another disk than the data.")]
_SHOWN = 3


@single("ultragray backup /mnt/backups --keep 14", "ultragray backup /mnt/backups --verify  # reads every byte")
@with_options
def backup(
    folder: BackupFolder,
    verify: Annotated[
        bool, option("Make none: read all backups of the folder and check every hash.", "--verify")
    ] = False,
    keep: Annotated[
        int | None, option("Remove all but so many of the newest backups of the folder.", min=1, shown="all")
    ] = None,
    json: Json = False,
    *,
    where: Where,
) -> None:
    """Service and workers go on meanwhile.

    Again into the same folder it copies only what is new. Exit code 2: there is no new backup, or one is damaged.
    """
    if verify:
        _verify(folder, as_json=json)
        return
    from ultragray_workers.backup.backing_up import back_up

    settings = load_settings(**where)
    report = back_up(folders_of(settings), settings.database_url, folder, keep=keep)
    lines = [in_words(report.manifest), f"new: {report.new_files:,} files, {megabytes(report.new_bytes)}"]
    if report.removed_backups:
        lines.append(f"removed: {report.removed_backups} older backups, {megabytes(report.removed_bytes)}")
    counts = ("new_files", "new_bytes", "removed_backups", "removed_bytes")
    document = {**document_of(report.manifest), **{name: getattr(report, name) for name in counts}}
    tell("\n".join(lines), document, as_json=json)


def _verify(folder: Path, *, as_json: bool) -> None:
    from ultragray_workers.backup.backing_up import verify

    damaged: dict[str, list[str]] = {}
    backups: list[dict[str, Any]] = []
    for manifest, bad in verify(folder):
        backups.append({**document_of(manifest), "damaged": bad})
        if not as_json:
            typer.echo(f"{in_words(manifest)}: {f'{len(bad)} contents missing or damaged' if bad else 'whole'}")
        if bad:
            damaged[manifest.name] = bad
    if as_json:
        typer.echo(to_json(backups))
    if not backups:
        raise BackupInvalid(f"{folder} holds no backup")
    if damaged:
        name, bad = next(iter(damaged.items()))
        raise BackupInvalid(
            f"{len(damaged)} of {len(backups)} backups are damaged; of {name}: {', '.join(bad[:_SHOWN])}"
        )


def folders_of(settings: Settings) -> Folders:
    from ultragray_workers.backup.contents import Folders

    data, artifacts = settings.data_folder, settings.artifacts
    if not isinstance(data, Path) or not isinstance(artifacts, Path):
        raise InvalidArgument(
            "backups are of folders: what is in a bucket is kept by its versions and replication, and the database by "
            "that of PostgreSQL",
            field="artifact_folder" if isinstance(data, Path) else "data_folder",
        )
    return Folders(data, artifacts)


def in_words(manifest: Manifest) -> str:
    counts = ", ".join(f"{count:,} {what}" for what, count in manifest.counts.items())
    return f"backup {manifest.name}: {counts}; {len(manifest.files):,} files, {megabytes(manifest.bytes)}"


def document_of(manifest: Manifest) -> dict[str, Any]:
    return {"backup": manifest.name, **manifest.counts, "files": len(manifest.files), "bytes": manifest.bytes}


def megabytes(size: int) -> str:
    return f"{size / 1e6:,.1f} MB"


@single(
    "ultragray restore /mnt/backups --data-folder /srv/ultragray/data",
    "ultragray restore /mnt/backups --backup 20261122T070301.123Z --force",
)
@with_options
def restore(
    folder: BackupFolder,
    backup: Annotated[str | None, option("Name of a backup of the folder.", shown="the newest")] = None,
    force: Annotated[bool, option("Replace all that the folders and the database hold now.", "--force")] = False,
    json: Json = False,
    *,
    where: Where,
) -> None:
    """Service and workers must be stopped.

    Every hash is checked before anything is changed. Interrupted, the same command goes on. Jobs that ran at the time
    of the backup wait again, and go on from their checkpoints.
    """
    from ultragray_workers.backup.restoring import restore as restore_backup

    settings = load_settings(**where)
    manifest = restore_backup(
        folder,
        folders_of(settings),
        settings.database_url,
        name=backup,
        overwrite=force,
        say=partial(typer.echo, err=True),
    )
    tell(f"restored {in_words(manifest)}", document_of(manifest), as_json=json)


storage_app = command_group("A place is a folder, or a bucket: s3://BUCKET/PREFIX, gs://, az://.")


@storage_app.callback()
def places() -> None:
    """Makes it a group: of an app with one command typer makes that command."""


@storage_app.command(
    epilog=examples(
        "ultragray storage copy /srv/ultragray/data s3://hospital/ultragray",
        "ultragray storage copy /srv/ultragray/artifacts s3://hospital/ultragray/artifacts",
    )
)
@with_options
def copy(
    source: Annotated[str, argument("Data or artifact folder, or its URL.", metavar="FROM")],
    target: Annotated[str, argument("Where its scenes and datasets go.", metavar="TO")],
    *,
    json: Json = False,
) -> None:
    """Copy the scenes of an installation, and check every hash; likewise its datasets.

    Interrupted, the same command goes on. Nothing is changed in FROM, and nothing overwritten in TO.
    """
    from ultragray_workers.backup.copying import ARTIFACTS, CopiedDatasets, copy_datasets, copy_scenes
    from ultragray_workers.storage.location import below, open_storage, parse_location

    say = partial(typer.echo, err=True)
    here, there = parse_location(source, "FROM"), parse_location(target, "TO")
    if isinstance(here, Path) and not here.is_dir():
        raise InvalidArgument(f"FROM must be an existing folder or the URL of a bucket, got {source!r}", field="FROM")
    done = copy_scenes(open_storage(here), open_storage(there), say)
    in_data = copy_datasets(open_storage(here), open_storage(there), say)
    in_artifacts = copy_datasets(open_storage(below(here, ARTIFACTS)), open_storage(below(there, ARTIFACTS)), say)
    datasets = CopiedDatasets(*map(sum, zip(astuple(in_data), astuple(in_artifacts), strict=True)))
    line = (
        f"scene files: {done.scenes:,} copied ({megabytes(done.bytes)}), {done.already_there:,} already there; "
        f"datasets: {datasets.datasets:,} copied, {datasets.datasets_already_there:,} already there"
    )
    tell(line, {**asdict(done), **asdict(datasets)}, as_json=json)
