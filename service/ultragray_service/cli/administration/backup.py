"""`ultragray backup`: a whole installation into a folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.errors import InvalidArgument
from ultragray_service.cli.administration.database import Where
from ultragray_service.cli.options import with_options
from ultragray_service.cli.style import Json, command_group, examples, tell, to_json
from ultragray_service.settings import Settings, load_settings
from ultragray_workers.errors import BackupInvalid

if TYPE_CHECKING:
    from ultragray_workers.backup.contents import Folders
    from ultragray_workers.backup.manifest import Manifest

BackupFolder = Annotated[
    Path, typer.Argument(help="Folder of backups, on another disk than the data.", show_default=False)
]
_SHOWN = 3
command_app = command_group()


@command_app.command(
    epilog=examples(
        "ultragray backup /mnt/backups --keep 14", "ultragray backup /mnt/backups --verify  # reads every byte"
    )
)
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
    document = {
        **document_of(report.manifest),
        "new_files": report.new_files,
        "new_bytes": report.new_bytes,
        "removed_backups": report.removed_backups,
        "removed_bytes": report.removed_bytes,
    }
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
    """The folders that a backup saves. Raises InvalidArgument where they are in a bucket."""
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
    """A backup in one sentence."""
    counts = ", ".join(f"{count:,} {what}" for what, count in manifest.counts.items())
    return f"backup {manifest.name}: {counts}; {len(manifest.files):,} files, {megabytes(manifest.bytes)}"


def document_of(manifest: Manifest) -> dict[str, Any]:
    """The same for a program."""
    return {"backup": manifest.name, **manifest.counts, "files": len(manifest.files), "bytes": manifest.bytes}


def megabytes(size: int) -> str:
    """A size for a person, in 10^6 bytes."""
    return f"{size / 1e6:,.1f} MB"
