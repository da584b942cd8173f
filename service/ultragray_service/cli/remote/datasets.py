"""`ultragray datasets …`: the sweeps that a running service keeps for trainings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.datasets.source import UPLOAD_OPTIONS, SourceOptions
from ultragray.errors import InvalidArgument
from ultragray_service.cli.options import with_options
from ultragray_service.cli.remote.connection import with_connection
from ultragray_service.cli.scenes import print_facts
from ultragray_service.cli.sweeps import SWEEP_MEANING
from ultragray_service.cli.terminal import Json, command_group, examples, print_table, tell, to_json, transferred, warn

if TYPE_CHECKING:
    from ultragray_service.remote.connection import Connection

command_app = command_group("They are checked when they arrive; `ultragray jobs submit train NAME` trains from one.")
DatasetName = Annotated[str, typer.Argument(metavar="NAME", help="Name of the dataset.", show_default=False)]
_COLUMNS = ("name", "format", "training", "held out", "pixels", "MB", "created", "owner")


@command_app.command(
    "list", epilog=examples("ultragray datasets list", "ultragray datasets list --json | jq '.[].name'")
)
@with_connection
def list_datasets(connection: Connection, json: Json = False) -> None:
    """List the datasets by name."""
    from ultragray_service.remote.datasets import Datasets

    found = Datasets(connection).all()
    if json:
        typer.echo(to_json(found))
    else:
        print_table(_COLUMNS, map(_row, found))


@command_app.command(epilog=examples("ultragray datasets show liver"))
@with_connection
def show(connection: Connection, name: DatasetName, json: Json = False) -> None:
    """Print size, probe and split of a dataset, and what its check warned of."""
    from ultragray_service.remote.datasets import Datasets

    found = Datasets(connection).get(name)
    if json:
        typer.echo(to_json(found))
    else:
        print_facts(found)


@command_app.command(
    epilog=examples(
        "ultragray datasets upload sweep/  # a folder is zipped on the way",
        "ultragray datasets upload scan.igs.mha --device-set plus.xml --name liver",
        "ultragray datasets upload sweep.zip --val-frames 80:100 --private",
    )
)
@with_options
@with_connection
def upload(
    connection: Connection,
    sweep: Annotated[
        Path, typer.Argument(metavar="SWEEP", help=f"An archive (.zip, .tar), or {SWEEP_MEANING}.", show_default=False)
    ],
    name: Annotated[
        str | None, typer.Option(help="Name of the dataset.", show_default="that of the file or folder")
    ] = None,
    private: Annotated[bool, typer.Option("--private", help="Others do not see it.")] = False,
    json: Json = False,
    *,
    source: SourceOptions,
) -> None:
    """Upload a sweep; the service checks it as `ultragray check` does, and keeps it."""
    from ultragray_service.remote.datasets import Datasets, archive_of

    called = _name_of(sweep) if name is None else name
    options = {key: str(value) for key in UPLOAD_OPTIONS if (value := getattr(source, key)) is not None}
    with archive_of(sweep, source.device_set) as archive, transferred(f"uploading {called}") as begin:
        count = begin(archive.stat().st_size)
        record, is_new = Datasets(connection).upload(called, archive, options, count, private=private)
    for text in record["warnings"]:
        warn(text)
    frames = f"{record['train_frames']} training and {record['val_frames']} held-out frames"
    was = f"uploaded {called}" if is_new else f"{called} is there already, the same"
    tell(f"{was}: {frames} of {record['width']}x{record['height']}", record, as_json=json)


@command_app.command(epilog=examples("ultragray datasets delete liver"))
@with_connection
def delete(connection: Connection, name: DatasetName, json: Json = False) -> None:
    """Delete a dataset that no job needs."""
    from ultragray_service.remote.datasets import Datasets

    Datasets(connection).delete(name)
    tell(f"{name} deleted", {"deleted": name}, as_json=json)


def _name_of(sweep: Path) -> str:
    found = sweep.resolve()
    name = (found.parent if found.name == "conf.json" else found).name.split(".")[0]
    if not name:
        raise InvalidArgument(f"--name must be given: {sweep} has none", field="name")
    return name


def _row(record: dict[str, Any]) -> tuple[str, ...]:
    return (
        record["name"],
        record["kind"],
        str(record["train_frames"]),
        str(record["val_frames"]),
        f"{record['width']}x{record['height']}",
        f"{record['bytes'] / 1e6:,.1f}",
        str(record["created_at"])[:19].replace("T", " "),
        f"{record['owner'] or ''}{' (private)' if record['private'] else ''}",
    )
