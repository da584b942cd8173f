"""`ultragray restore`: an installation as it was at a backup."""

from __future__ import annotations

from typing import Annotated

import typer

from ultragray_service.cli.administration.backup import BackupFolder, document_of, folders_of, in_words
from ultragray_service.cli.administration.database import Where
from ultragray_service.cli.options import with_options
from ultragray_service.cli.style import Json, command_group, examples, tell
from ultragray_service.settings import load_settings

command_app = command_group()


@command_app.command(
    epilog=examples(
        "ultragray restore /mnt/backups --data-folder /srv/ultragray/data",
        "ultragray restore /mnt/backups --backup 20261122T070301.123Z --force",
    )
)
@with_options
def restore(
    folder: BackupFolder,
    backup: Annotated[
        str | None, typer.Option(help="Name of a backup of the folder.", show_default="the newest")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace all that the folders and the database hold now.")
    ] = False,
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
        say=lambda sentence: typer.echo(sentence, err=True),
    )
    tell(f"restored {in_words(manifest)}", document_of(manifest), as_json=json)
