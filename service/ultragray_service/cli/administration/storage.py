"""`ultragray storage …`: the places in which an installation keeps its scenes."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from ..options import with_options
from ..style import Json, command_group, examples, tell
from .backup import megabytes

command_app = command_group("A place is a folder, or a bucket: s3://BUCKET/PREFIX, gs://, az://.")


@command_app.command(
    epilog=examples(
        "ultragray storage copy /srv/ultragray/data s3://hospital/ultragray",
        "ultragray storage copy /srv/ultragray/artifacts s3://hospital/ultragray/artifacts",
    )
)
@with_options
def copy(
    source: Annotated[
        str, typer.Argument(metavar="FROM", help="Data or artifact folder, or its URL.", show_default=False)
    ],
    target: Annotated[str, typer.Argument(metavar="TO", help="Where its scenes go.", show_default=False)],
    *,
    json: Json = False,
) -> None:
    """Copy the scenes of an installation, those that were imported or trained among them, and check every hash.

    Interrupted, the same command goes on. Nothing is changed in FROM, and nothing overwritten in TO.
    """
    from ultragray_workers.storage.copying import copy_scenes
    from ultragray_workers.storage.location import parse_location
    from ultragray_workers.storage.opening import open_storage

    done = copy_scenes(
        open_storage(parse_location(source, "FROM")),
        open_storage(parse_location(target, "TO")),
        say=lambda sentence: typer.echo(sentence, err=True),
    )
    line = f"copied {done.scenes:,} files, {megabytes(done.bytes)}; {done.already_there:,} were there already"
    tell(line, asdict(done), as_json=json)
