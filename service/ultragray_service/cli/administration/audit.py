"""`ultragray audit`: who did what on a service, from the database of its jobs."""

from __future__ import annotations

import json as json_text
import time
from dataclasses import asdict
from datetime import datetime, timezone
from typing import Annotated, Any

import typer

from ...settings import ENVIRONMENT_PREFIX, Settings, load_settings
from ..options import FieldsOf, with_options
from ..output import print_table

_COLUMNS = ("time", "who", "address", "what", "target", "result", "facts")
_HOUR_S = 3600.0


@with_options
def audit(
    *,
    since_hours: Annotated[float, typer.Option(min=0.0, help="How far back.")] = 24.0,
    who: Annotated[str | None, typer.Option(help="Only of this name.", show_default="all")] = None,
    what: Annotated[
        str | None, typer.Option(help="Only this operation, such as scene.delete, or scene.", show_default="all")
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="The last ones, at most.")] = 1000,
    json: Annotated[bool, typer.Option("--json", help="A JSON object a line, for scripts.")] = False,
    where: Annotated[
        dict[str, Any],
        FieldsOf(Settings, "data_folder", "artifact_folder", "database_url", environment=ENVIRONMENT_PREFIX),
    ],
) -> None:
    """Print the audit log, oldest first: who, from where, what, on which scene, dataset or job, with which result."""
    from ultragray_workers.jobs.queue.database import JobDatabase

    from ...access.audit import read_audit

    settings = load_settings(**where)
    database = JobDatabase(settings.artifacts, settings.database_url)
    try:
        since_s = time.time() - since_hours * _HOUR_S
        entries = read_audit(database.engine, since_s=since_s, who=who, what=what, limit=limit)
    finally:
        database.close()
    if json:
        for entry in entries:
            typer.echo(json_text.dumps({**asdict(entry), "time": _time(entry.at_s)}))
        return
    rows = [
        (_time(one.at_s), one.who, one.address, one.what, one.target, one.result, json_text.dumps(one.facts))
        for one in entries
    ]
    print_table(_COLUMNS, rows)


def _time(at_s: float) -> str:
    return datetime.fromtimestamp(at_s, timezone.utc).isoformat(timespec="milliseconds")
