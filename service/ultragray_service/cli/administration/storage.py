"""`ultragray storage …`: the places in which an installation keeps its scenes and datasets."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from ultragray.errors import InvalidArgument
from ultragray_service.cli.administration.backup import megabytes
from ultragray_service.cli.options import with_options
from ultragray_service.cli.style import Json, command_group, examples, tell

command_app = command_group("A place is a folder, or a bucket: s3://BUCKET/PREFIX, gs://, az://.")


@command_app.callback()
def places() -> None:
    """Makes it a group: of an app with one command typer makes that command."""


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
    target: Annotated[str, typer.Argument(metavar="TO", help="Where its scenes and datasets go.", show_default=False)],
    *,
    json: Json = False,
) -> None:
    """Copy the scenes of an installation, and check every hash; from a folder into a bucket its datasets, too.

    Interrupted, the same command goes on. Nothing is changed in FROM, and nothing overwritten in TO.
    """
    from ultragray_workers.datasets.copying import CopiedDatasets, copy_datasets
    from ultragray_workers.storage.copying import ARTIFACTS, copy_scenes
    from ultragray_workers.storage.location import StorageUrl, parse_location
    from ultragray_workers.storage.opening import open_storage

    def say(sentence: str) -> None:
        typer.echo(sentence, err=True)

    here, there = parse_location(source, "FROM"), parse_location(target, "TO")
    if isinstance(here, Path) and not here.is_dir():
        raise InvalidArgument(f"FROM must be an existing folder or the URL of a bucket, got {source!r}", field="FROM")
    done = copy_scenes(open_storage(here), open_storage(there), say)
    datasets = CopiedDatasets()
    if isinstance(here, Path) and isinstance(there, StorageUrl):
        below = here / ARTIFACTS  # of a data folder
        of_data = below.is_dir()
        datasets = copy_datasets(
            below if of_data else here, open_storage(there.below(ARTIFACTS) if of_data else there), say
        )
    line = (
        f"scene files: {done.scenes:,} copied ({megabytes(done.bytes)}), {done.already_there:,} already there; "
        f"datasets: {datasets.datasets:,} copied, {datasets.datasets_already_there:,} already there"
    )
    tell(line, {**asdict(done), **asdict(datasets)}, as_json=json)
