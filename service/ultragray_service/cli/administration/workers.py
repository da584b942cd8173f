"""`ultragray workers …`: who does the jobs, and who is to rest, by the database of the jobs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ...settings import ENVIRONMENT_PREFIX, Settings, load_settings
from ..options import FieldsOf, with_options
from ..output import print_table
from ..style import Json, command_group, examples, tell, to_json

if TYPE_CHECKING:
    from ultragray_workers.jobs.queue.database import JobDatabase

command_app = command_group("They are told through the database of the jobs, and obey within two seconds.")

Name = Annotated[str, typer.Argument(help="Name of the worker.", show_default=False)]
Where = Annotated[
    dict[str, Any],
    FieldsOf(Settings, "data_folder", "artifact_folder", "database_url", environment=ENVIRONMENT_PREFIX),
]
_COLUMNS = ("name", "state", "job", "host", "pid", "device", "version", "started", "last sign")


@command_app.command("list", epilog=examples("ultragray workers list", "ultragray workers list --json"))
@with_options
def list_workers(
    *,
    json: Json = False,
    where: Where,
) -> None:
    """List the workers, also those that were lost within a day."""
    from ultragray_workers.jobs.queue import attendance

    with _database(where) as jobs:
        workers = attendance.list_workers(jobs)
    if json:
        typer.echo(to_json([asdict(worker) for worker in workers]))
        return
    rows = [
        (
            worker.name,
            worker.state.value,
            worker.job or "",
            worker.host,
            str(worker.pid),
            worker.device,
            worker.version,
            (worker.started_at or "")[:19].replace("T", " "),
            "" if worker.seconds_since_beat is None else f"{worker.seconds_since_beat:.0f} s ago",
        )
        for worker in workers
    ]
    print_table(_COLUMNS, rows)


@command_app.command(epilog=examples("ultragray workers pause gpu-1"))
@with_options
def pause(name: Name, *, json: Json = False, where: Where) -> None:
    """Let a worker take no more jobs; it ends the one at hand. Holds until resume, restarts included."""
    _want(where, name, "pause", as_json=json)


@command_app.command(epilog=examples("ultragray workers drain gpu-1"))
@with_options
def drain(name: Name, *, json: Json = False, where: Where) -> None:
    """As pause, but a training at hand goes back into the queue at once, and on elsewhere from its checkpoint."""
    _want(where, name, "drain", as_json=json)


@command_app.command(epilog=examples("ultragray workers resume gpu-1"))
@with_options
def resume(name: Name, *, json: Json = False, where: Where) -> None:
    """Let a worker take jobs again."""
    _want(where, name, "work", as_json=json)


def _want(where: dict[str, Any], name: str, wanted: str, *, as_json: bool) -> None:
    from ultragray_workers.jobs.queue import attendance
    from ultragray_workers.jobs.queue.wishes import Wanted

    with _database(where) as jobs:
        worker = attendance.want(jobs, name, Wanted(wanted))
    at_hand = f", at the job {worker.job}" if worker.job else ""
    tell(f"{worker.name} {worker.state.value}{at_hand}", asdict(worker), as_json=as_json)


@contextmanager
def _database(where: dict[str, Any]) -> Iterator[JobDatabase]:
    from ultragray_workers.jobs.queue.database import JobDatabase

    settings = load_settings(**where)
    jobs = JobDatabase(settings.artifacts, settings.database_url)
    try:
        yield jobs
    finally:
        jobs.close()
