"""`ultragray keys …`: the named API keys of a service, in the database of its jobs."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray_service.access.principals import NAMES, Role, read_limits
from ultragray_service.cli.administration.database import Where, opened_database
from ultragray_service.cli.options import with_options
from ultragray_service.cli.output import print_table
from ultragray_service.cli.style import Json, command_group, examples, tell, to_json
from ultragray_service.settings import Settings, load_settings

if TYPE_CHECKING:
    from ultragray_service.access.keys import Key, KeyStore

command_app = command_group("They live in the installation's database; changes count within two seconds.")

_COLUMNS = ("id", "name", "role", "state", "created", "expires", "last used", "limits")


@command_app.command(
    epilog=examples(
        "ultragray keys create alice --role operator --expires-days 90",
        "ultragray keys create console --role reader --limit frames_per_s=60",
    )
)
@with_options
def create(
    name: Annotated[str, typer.Argument(help="Whose it is: a person, a machine or a program.", show_default=False)],
    *,
    role: Annotated[
        Role,
        typer.Option(
            help="reader: sees, renders, streams; operator: and has jobs, datasets and scenes; admin: everything."
        ),
    ],
    expires_days: Annotated[
        float | None, typer.Option(min=0.0, max=36_500.0, help="Days that it counts.", show_default="for ever")
    ] = None,
    limit: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=NUMBER",
            help=f"A limit of its own, NAME=none: no limit; may be repeated. Names: {', '.join(NAMES)}.",
            show_default="the settings key_NAME of the service",
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
    typer.echo(f"key {key.id} of {key.name}, {_role(key)}, expires: {_time(key.expires_at_s, 'never')}", err=True)
    for other in others:
        typer.echo(f"{name} still has the key {other.id}, {_role(other)}, too", err=True)
    typer.echo("Keep it now: it is shown only once.", err=True)
    tell(secret, {**_document(key), "secret": secret}, as_json=json)


@command_app.command("list", epilog=examples("ultragray keys list", "ultragray keys list --json"))
@with_options
def list_keys(
    *,
    json: Json = False,
    where: Where,
) -> None:
    """List the keys, oldest first, also those that count no more; no secrets."""
    with _key_store(where) as store:
        keys = list(store.keys().values())
    if json:
        typer.echo(to_json([_document(key) for key in keys]))
        return
    print_table(_COLUMNS, [_row(key) for key in keys])


@command_app.command(epilog=examples("ultragray keys revoke alice"))
@with_options
def revoke(
    name: Annotated[str, typer.Argument(help="Name, or id of one key.", show_default=False)],
    *,
    json: Json = False,
    where: Where,
) -> None:
    """Revoke all keys of a name, or the one of an id. What runs on them is cut within two seconds."""
    with _key_store(where) as store:
        revoked = store.revoke(name)
    lines = [f"revoked {key.id} of {key.name}, {_role(key)}" for key in revoked]
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
    return {**asdict(key), "state": _state(key)}


def _row(key: Key) -> tuple[str, ...]:
    return (
        key.id,
        key.name,
        _role(key),
        _state(key),
        _time(key.created_at_s, ""),
        _time(key.expires_at_s, "never"),
        _time(key.last_used_at_s, "never"),
        " ".join(f"{name}={'none' if value is None else f'{value:g}'}" for name, value in key.limits.items()),
    )


def _role(key: Key) -> str:
    return "unknown" if key.role is None else key.role.value


def _state(key: Key) -> str:
    if key.revoked_at_s is not None:
        return "revoked"
    return "valid" if key.is_valid(time.time()) else "expired"


def _time(at_s: float | None, otherwise: str) -> str:
    if at_s is None:
        return otherwise
    return datetime.fromtimestamp(at_s, timezone.utc).isoformat(sep=" ", timespec="minutes")
