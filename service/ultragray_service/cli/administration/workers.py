"""`ultragray workers …`: who does the jobs, and who is to rest, by the database of the jobs."""

from __future__ import annotations

import json as json_text
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ...settings import ENVIRONMENT_PREFIX, Settings, load_settings
from ..options import FieldsOf, with_options
from ..output import print_table

if TYPE_CHECKING:
    from ultragray_workers.jobs.queue.database import JobDatabase

workers_app = typer.Typer(
    no_args_is_help=True, help="Workers for jobs: who is there, and who is to rest. They obey within two seconds."
)

Name = Annotated[str, typer.Argument(help="Name of the worker.", show_default=False)]
Where = Annotated[
    dict[str, Any],
    FieldsOf(Settings, "data_folder", "artifact_folder", "database_url", environment=ENVIRONMENT_PREFIX),
]
_COLUMNS = ("name", "state", "job", "host", "pid", "device", "version", "started", "last sign")


@workers_app.command("list")
@with_options
def list_workers(
    *,
    json: Annotated[bool, typer.Option("--json", help="A JSON list, for scripts.")] = False,
    where: Where,
) -> None:
    """List the workers, also those that were lost within a day."""
    from ultragray_workers.jobs.queue import attendance

    with _database(where) as jobs:
        workers = attendance.list_workers(jobs)
    if json:
        typer.echo(json_text.dumps([asdict(worker) for worker in workers], indent=2))
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


@workers_app.command()
@with_options
def pause(name: Name, *, where: Where) -> None:
    """Let a worker take no more jobs; it ends the one at hand. Holds until resume, restarts included."""
    _want(where, name, "pause")


@workers_app.command()
@with_options
def drain(name: Name, *, where: Where) -> None:
    """As pause, but a training at hand goes back into the queue at once, and on elsewhere from its checkpoint."""
    _want(where, name, "drain")


@workers_app.command()
@with_options
def resume(name: Name, *, where: Where) -> None:
    """Let a worker take jobs again."""
    _want(where, name, "work")


def _want(where: dict[str, Any], name: str, wanted: str) -> None:
    from ultragray_workers.jobs.queue import attendance
    from ultragray_workers.jobs.queue.wishes import Wanted

    with _database(where) as jobs:
        worker = attendance.want(jobs, name, Wanted(wanted))
    typer.echo(f"{worker.name} {worker.state.value}{f', at the job {worker.job}' if worker.job else ''}")


@contextmanager
def _database(where: dict[str, Any]) -> Iterator[JobDatabase]:
    from ultragray_workers.jobs.queue.database import JobDatabase

    settings = load_settings(**where)
    jobs = JobDatabase(settings.artifacts, settings.database_url)
    try:
        yield jobs
    finally:
        jobs.close()
