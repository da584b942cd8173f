"""`ultragray jobs …`: training, batch rendering and the other kinds of jobs on a running service."""

from __future__ import annotations

import inspect
import json as json_text
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import numpy as np
import typer

from ultragray.contract import to_dict
from ultragray.samplers import TrainingSampler
from ultragray_workers.jobs.kinds import KINDS, Specification

from ..options import parameters_of, values_of, with_parameters

jobs_app = typer.Typer(no_args_is_help=True, help="Train and render in the background, on a running service.")
submit_app = typer.Typer(no_args_is_help=True, help="Put a job into the queue; its id is printed.")
jobs_app.add_typer(submit_app, name="submit")

JobArgument = Annotated[str, typer.Argument(help="Id of the job.", show_default=False)]
Server = Annotated[str, typer.Option(help="URL of the service.", envvar="ULTRAGRAY_SERVER")]
ApiKey = Annotated[
    str | None, typer.Option(help="Where the service asks for one.", envvar="ULTRAGRAY_API_KEY", show_default=False)
]

_COLUMNS = ("id", "kind", "state", "scene", "progress", "created", "reason")
_PIPE_COLUMNS = 400  # where no terminal says how wide it is, nothing is cut


@jobs_app.command("list")
def list_jobs(
    state: Annotated[
        str, typer.Option(help="Only queued, running, succeeded, failed or cancelled ones.", show_default="all")
    ] = "",
    kind: Annotated[str, typer.Option(help=f"Only {' or '.join(KINDS)} ones.", show_default="all")] = "",
    limit: Annotated[int, typer.Option(min=1, help="How many at most.")] = 20,
    json: Annotated[bool, typer.Option("--json", help="A JSON list, for scripts.")] = False,
    server: Server = "http://127.0.0.1:8000",
    api_key: ApiKey = None,
) -> None:
    """List the jobs, newest first."""
    from ...core.job_client import JobClient

    jobs = JobClient(server, api_key).jobs(state=state, kind=kind, limit=limit)
    if json:
        typer.echo(json_text.dumps(jobs, indent=2))
    else:
        _print_jobs(jobs)


@jobs_app.command()
def watch(job: JobArgument, server: Server = "http://127.0.0.1:8000", api_key: ApiKey = None) -> None:
    """Follow a job to its end. Exit code 0: it succeeded, 3: it failed, 4: it was cancelled."""
    from ...core.job_client import JobClient
    from .watch import follow

    follow(JobClient(server, api_key), job)


@jobs_app.command()
def cancel(job: JobArgument, server: Server = "http://127.0.0.1:8000", api_key: ApiKey = None) -> None:
    """Stop a job."""
    from ...core.job_client import JobClient

    cancelled = JobClient(server, api_key).cancel(job)
    typer.echo(f"{cancelled['id']} {cancelled['state']}")


@jobs_app.command()
def retry(job: JobArgument, server: Server = "http://127.0.0.1:8000", api_key: ApiKey = None) -> None:
    """Put a new job in place of a failed or cancelled one; it goes on from the last checkpoint."""
    from ...core.job_client import JobClient

    typer.echo(JobClient(server, api_key).retry(job)["id"])


@jobs_app.command()
def delete(job: JobArgument, server: Server = "http://127.0.0.1:8000", api_key: ApiKey = None) -> None:
    """Remove a finished job and its files; the scene that it trained stays."""
    from ...core.job_client import JobClient

    JobClient(server, api_key).delete(job)
    typer.echo(f"{job} deleted")


@jobs_app.command()
def logs(
    job: JobArgument,
    max_bytes: Annotated[int, typer.Option("--bytes", min=1, max=2**20, help="How much of its end.")] = 65536,
    server: Server = "http://127.0.0.1:8000",
    api_key: ApiKey = None,
) -> None:
    """Print the end of a job's log."""
    from ...core.job_client import JobClient

    typer.echo(JobClient(server, api_key).log(job, max_bytes), nl=False)


@jobs_app.command()
def download(
    job: JobArgument,
    name: Annotated[str, typer.Argument(help="One of the job's artifacts.", show_default=False)],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write.", show_default="NAME, here")
    ] = None,
    server: Server = "http://127.0.0.1:8000",
    api_key: ApiKey = None,
) -> None:
    """Download a file that a job made."""
    from ...core.job_client import JobClient
    from ..output import check_writable

    path = Path(Path(name).name) if output is None else output
    check_writable(path)
    JobClient(server, api_key).download(job, name, path)
    typer.echo(f"wrote {path}: {path.stat().st_size:,} bytes")


def _submit(
    kind: str,
    specification: dict[str, Any],
    *,
    request_id: Annotated[
        str | None,
        typer.Option(help="A name of your own: given again, it gives the same job.", show_default=False),
    ] = None,
    priority: Annotated[int, typer.Option(min=-1000, max=1000, help="Higher ones go first.")] = 0,
    wait: Annotated[bool, typer.Option("--wait", help="Follow the job to its end, as `jobs watch` does.")] = False,
    server: Server = "http://127.0.0.1:8000",
    api_key: ApiKey = None,
) -> None:
    from ...core.job_client import JobClient
    from .watch import follow

    client = JobClient(server, api_key)
    body = {"kind": kind, "specification": specification, "request_id": request_id, "priority": priority}
    job, _ = client.submit(body)
    typer.echo(job["id"])
    if wait:
        follow(client, job["id"])


def _add_submit_command(kind: str, cls: type[Specification]) -> None:
    """`jobs submit KIND`, with an option for each field of the specification."""
    hints = get_type_hints(_submit, include_extras=True)
    common = [
        parameter.replace(annotation=hints[parameter.name])
        for parameter in inspect.signature(_submit).parameters.values()
        if parameter.kind is parameter.KEYWORD_ONLY
    ]

    def submit(**given: Any) -> None:
        values = values_of(cls, given)
        if {"sampler", "poses"} <= given.keys() and not {"sampler", "poses"} & values.keys():
            values["sampler"] = TrainingSampler()
        document = {name: _as_json(value) for name, value in values.items()}
        _submit(kind, document, **{parameter.name: given[parameter.name] for parameter in common})

    summary = inspect.getdoc(cls) or ""
    submit_app.command(kind, help=summary.split("\n\n")[0])(with_parameters(submit, [*parameters_of(cls), *common]))


def _as_json(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else to_dict(value, with_none=False)


for _kind, _class in Specification.members.items():
    _add_submit_command(_kind, _class)


def _print_jobs(jobs: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    from .watch import amount

    console = Console()
    if not console.is_terminal:
        console.width = _PIPE_COLUMNS
    table = Table(*_COLUMNS, box=None, pad_edge=False)
    table.columns[0].no_wrap = True
    for job in jobs:
        created = str(job["created_at"])[:19].replace("T", " ")
        scene = str(job["specification"].get("scene", ""))
        table.add_row(job["id"], job["kind"], job["state"], scene, amount(job), created, job["reason"] or "")
    console.print(table)
