"""`ultragray audit`: who did what on a service, from the database of its jobs."""

from __future__ import annotations

import json as json_text
import time
from dataclasses import asdict
from datetime import datetime, timezone
from typing import Annotated

import typer

from ultragray_service.cli.administration.database import Where, opened_database
from ultragray_service.cli.options import with_options
from ultragray_service.cli.output import print_table
from ultragray_service.cli.style import Json, command_group, examples, to_json

_COLUMNS = ("time", "who", "address", "what", "target", "result", "facts")
_HOUR_S = 3600.0


command_app = command_group()


@command_app.command(
    epilog=examples("ultragray audit --since-hours 168 --who console", "ultragray audit --what scene.delete --json")
)
@with_options
def audit(
    *,
    since_hours: Annotated[float, typer.Option(min=0.0, help="How far back.")] = 24.0,
    who: Annotated[str | None, typer.Option(help="Only of this name.", show_default="all")] = None,
    what: Annotated[
        str | None, typer.Option(help="Only this operation, such as scene.delete, or scene.", show_default="all")
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="The last ones, at most.")] = 1000,
    json: Json = False,
    where: Where,
) -> None:
    """Oldest first. What is not given here comes from the settings (ULTRAGRAY_…)."""
    from ultragray_service.access.audit import read_audit

    since_s = time.time() - since_hours * _HOUR_S
    with opened_database(where) as database:
        entries = read_audit(database.engine, since_s=since_s, who=who, what=what, limit=limit)
    if json:
        typer.echo(to_json([{**asdict(entry), "time": _time(entry.at_s)} for entry in entries]))
        return
    rows = [
        (_time(one.at_s), one.who, one.address, one.what, one.target, one.result, json_text.dumps(one.facts))
        for one in entries
    ]
    print_table(_COLUMNS, rows)


def _time(at_s: float) -> str:
    return datetime.fromtimestamp(at_s, timezone.utc).isoformat(timespec="milliseconds")
