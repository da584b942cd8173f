"""`ultragray backup` and `ultragray restore`: a whole installation into a folder, and back."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray_workers.errors import BackupInvalid

from ...settings import ENVIRONMENT_PREFIX, Settings, load_settings
from ..options import FieldsOf, with_options

if TYPE_CHECKING:
    from ultragray_workers.backup.contents import Folders
    from ultragray_workers.backup.manifest import Manifest

BackupFolder = Annotated[
    Path, typer.Argument(help="Folder of backups, on another disk than the data.", show_default=False)
]
Stores = Annotated[
    dict[str, Any],
    FieldsOf(Settings, "data_folder", "artifact_folder", "database_url", environment=ENVIRONMENT_PREFIX),
]
_SHOWN = 3


@with_options
def backup(
    folder: BackupFolder,
    verify: Annotated[
        bool, typer.Option("--verify", help="Make none: read all backups of the folder and check every hash.")
    ] = False,
    keep: Annotated[
        int | None,
        typer.Option(min=1, help="Remove all but so many of the newest backups of the folder.", show_default="all"),
    ] = None,
    *,
    stores: Stores,
) -> None:
    """Save scenes, datasets, jobs and their database into a folder, while service and workers go on.

    Again into the same folder it copies only what is new. Exit code 2: there is no new backup, or one is damaged.
    """
    if verify:
        _verify(folder)
        return
    from ultragray_workers.backup.backing_up import back_up

    settings = load_settings(**stores)
    report = back_up(_folders(settings), settings.database_url, folder, keep=keep)
    typer.echo(_in_words(report.manifest))
    typer.echo(f"new: {report.new_files:,} files, {_mb(report.new_bytes)}")
    if report.removed_backups:
        typer.echo(f"removed: {report.removed_backups} older backups, {_mb(report.removed_bytes)}")


@with_options
def restore(
    folder: BackupFolder,
    backup: Annotated[
        str | None, typer.Option(help="Name of a backup of the folder.", show_default="the newest")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace all that the folders and the database hold now.")
    ] = False,
    *,
    stores: Stores,
) -> None:
    """Make an installation what it was at a backup; service and workers must be stopped.

    Every hash is checked before anything is changed. Interrupted, the same command goes on. Jobs that ran at the time
    of the backup wait again, and go on from their checkpoints.
    """
    from ultragray_workers.backup.restoring import restore as restore_backup

    settings = load_settings(**stores)
    manifest = restore_backup(
        folder,
        _folders(settings),
        settings.database_url,
        name=backup,
        overwrite=overwrite,
        say=lambda sentence: typer.echo(sentence, err=True),
    )
    typer.echo(f"restored {_in_words(manifest)}")


def _verify(folder: Path) -> None:
    from ultragray_workers.backup.backing_up import verify

    damaged: dict[str, list[str]] = {}
    found = 0
    for manifest, bad in verify(folder):
        found += 1
        typer.echo(f"{_in_words(manifest)}: {f'{len(bad)} contents missing or damaged' if bad else 'whole'}")
        if bad:
            damaged[manifest.name] = bad
    if not found:
        raise BackupInvalid(f"{folder} holds no backup")
    if damaged:
        name, bad = next(iter(damaged.items()))
        raise BackupInvalid(f"{len(damaged)} of {found} backups are damaged; of {name}: {', '.join(bad[:_SHOWN])}")


def _folders(settings: Settings) -> Folders:
    from ultragray_workers.backup.contents import Folders

    return Folders(settings.data_folder, settings.artifacts)


def _in_words(manifest: Manifest) -> str:
    counts = ", ".join(f"{count:,} {what}" for what, count in manifest.counts.items())
    return f"backup {manifest.name}: {counts}; {len(manifest.files):,} files, {_mb(manifest.bytes)}"


def _mb(size: int) -> str:
    return f"{size / 1e6:,.1f} MB"
