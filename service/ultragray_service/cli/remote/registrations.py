"""`ultragray registrations …`: how robots and trackers lie to the scenes of a running service."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray_service.cli.remote.connection import with_connection
from ultragray_service.cli.scenes import print_facts
from ultragray_service.cli.terminal import Json, command_group, examples, print_table, tell, to_json

if TYPE_CHECKING:
    from ultragray_service.remote.connection import Connection

command_app = command_group("Requests that name one have poses in the robot's or tracker's own frame.")
RegistrationName = Annotated[str, typer.Argument(metavar="NAME", help="Name of the registration.", show_default=False)]
_COLUMNS = ("name", "scene", "residual mm", "changed", "owner")


@command_app.command(
    "list", epilog=examples("ultragray registrations list", "ultragray registrations list --json | jq '.[].name'")
)
@with_connection
def list_registrations(connection: Connection, json: Json = False) -> None:
    """List the registrations by name."""
    from ultragray_service.remote.registrations import Registrations

    found = Registrations(connection).all()
    if json:
        typer.echo(to_json(found))
    else:
        print_table(_COLUMNS, map(_row, found))


@command_app.command(epilog=examples("ultragray registrations show robot"))
@with_connection
def show(connection: Connection, name: RegistrationName, json: Json = False) -> None:
    """Print both links of a registration, mm, and how exact it is."""
    from ultragray_service.remote.registrations import Registrations

    found = Registrations(connection).get(name)
    if json:
        typer.echo(to_json(found))
    else:
        print_facts(found)


@command_app.command(
    epilog=examples(
        "ultragray registrations upload robot.json --scene demo",
        "ultragray registrations upload robot.json --scene demo --name room-2",
    )
)
@with_connection
def upload(
    connection: Connection,
    file: Annotated[Path, typer.Argument(help="File of `ultragray calibrate` (.json).", show_default=False)],
    scene: Annotated[str, typer.Option(help="Name of the scene that it leads into.", show_default=False)],
    name: Annotated[str | None, typer.Option(help="Name of the registration.", show_default="that of the file")] = None,
    json: Json = False,
) -> None:
    """Have the service keep a registration, in place of one of that name which is yours."""
    from ultragray.geometry.registration import load_registration
    from ultragray_service.remote.registrations import Registrations

    called = file.stem if name is None else name
    kept = Registrations(connection).put(called, scene, load_registration(file))
    tell(f"uploaded {called}, of the scene {kept['scene']}", kept, as_json=json)


@command_app.command(epilog=examples("ultragray registrations delete robot"))
@with_connection
def delete(connection: Connection, name: RegistrationName, json: Json = False) -> None:
    """Forget a registration. Jobs that were accepted with it keep it."""
    from ultragray_service.remote.registrations import Registrations

    Registrations(connection).delete(name)
    tell(f"{name} deleted", {"deleted": name}, as_json=json)


def _row(found: dict[str, Any]) -> tuple[str, ...]:
    residual_mm = found["residual_mm"]
    return (
        found["name"],
        found["scene"],
        "" if residual_mm is None else f"{residual_mm:.2g}",
        str(found["changed_at"])[:19].replace("T", " "),
        found["owner"] or "",
    )
