"""`ultragray workers …`: who does the jobs of a running service, and who is to rest."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray_service.cli.remote.connection import with_connection
from ultragray_service.cli.terminal import Json, command_group, examples, print_table, tell, to_json
from ultragray_workers.jobs.demand import GB

if TYPE_CHECKING:
    from ultragray_service.remote.connection import Connection

command_app = command_group("They obey within two seconds; `ultragray worker` starts one.")
Name = Annotated[str, typer.Argument(help="Name of the worker.", show_default=False)]
_COLUMNS = ("name", "state", "job", "host", "pid", "devices", "labels", "version", "started", "last sign")


@command_app.command("list", epilog=examples("ultragray workers list", "ultragray workers list --json"))
@with_connection
def list_workers(connection: Connection, json: Json = False) -> None:
    """List the workers, also those that were lost within a day."""
    from ultragray_service.remote.workers import Workers

    workers = Workers(connection).all()
    if json:
        typer.echo(to_json(workers))
    else:
        print_table(_COLUMNS, map(_row, workers))


@command_app.command(epilog=examples("ultragray workers pause gpu-1"))
@with_connection
def pause(connection: Connection, name: Name, json: Json = False) -> None:
    """Let a worker take no more jobs; it ends the one at hand. Holds until resume, restarts included."""
    _want(connection, name, "pause", as_json=json)


@command_app.command(epilog=examples("ultragray workers drain gpu-1"))
@with_connection
def drain(connection: Connection, name: Name, json: Json = False) -> None:
    """As pause, but a training at hand goes back into the queue at once, and on elsewhere from its checkpoint."""
    _want(connection, name, "drain", as_json=json)


@command_app.command(epilog=examples("ultragray workers resume gpu-1"))
@with_connection
def resume(connection: Connection, name: Name, json: Json = False) -> None:
    """Let a worker take jobs again."""
    _want(connection, name, "resume", as_json=json)


def _want(connection: Connection, name: str, wish: str, *, as_json: bool) -> None:
    from ultragray_service.remote.workers import Workers

    worker = Workers(connection).want(name, wish)
    at_hand = f", at the job {worker['job']}" if worker["job"] else ""
    tell(f"{worker['name']} {worker['state']}{at_hand}", worker, as_json=as_json)


def _row(worker: dict[str, Any]) -> tuple[str, ...]:
    beat_s = worker["seconds_since_beat"]
    return (
        worker["name"],
        worker["state"],
        worker["job"] or "",
        worker["host"],
        str(worker["pid"]),
        ", ".join(f"{device['name']} {device['memory_bytes'] / GB:.0f} GB" for device in worker["devices"]),
        " ".join(f"{name}={value}" for name, value in worker["labels"].items()),
        worker["version"],
        (worker["started_at"] or "")[:19].replace("T", " "),
        "" if beat_s is None else f"{beat_s:.0f} s ago",
    )
