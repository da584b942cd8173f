"""`ultragray jobs …`: training, batch rendering and the other kinds of jobs on a running service."""

from __future__ import annotations

import inspect
import json as json_text
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import numpy as np
import typer

from ultragray.contract import to_dict
from ultragray.samplers import TrainingSampler
from ultragray_workers.jobs.kinds import KINDS, Specification

from ..options import keyword, parameters_of, values_of, with_parameters

if TYPE_CHECKING:
    from ...core.job_client import JobClient

jobs_app = typer.Typer(no_args_is_help=True, help="Train and render in the background, on a running service.")
submit_app = typer.Typer(no_args_is_help=True, help="Put a job into the queue; its id is printed.")
jobs_app.add_typer(submit_app, name="submit")

JobArgument = Annotated[str, typer.Argument(help="Id of the job.", show_default=False)]
_SERVER = typer.Option(help="URL of the service.", envvar="ULTRAGRAY_SERVER")
_API_KEY = typer.Option(help="Where the service asks for one.", envvar="ULTRAGRAY_API_KEY", show_default=False)
_CA = typer.Option(
    help="Authorities (PEM) that sign the service's certificate.",
    envvar="ULTRAGRAY_CA",
    show_default="the system's",
)
_CERTIFICATE = typer.Option(
    help="Certificate (PEM) of the client, where the service asks for one.",
    envvar="ULTRAGRAY_CLIENT_CERTIFICATE",
    show_default=False,
)
_KEY = typer.Option(help="Its key (PEM), not encrypted.", envvar="ULTRAGRAY_CLIENT_KEY", show_default=False)
_CONNECTION = [
    keyword("server", Annotated[str, _SERVER], "http://127.0.0.1:8000"),
    keyword("api_key", Annotated[str | None, _API_KEY], None),
    keyword("ca", Annotated[Path | None, _CA], None),
    keyword("client_certificate", Annotated[Path | None, _CERTIFICATE], None),
    keyword("client_key", Annotated[Path | None, _KEY], None),
]

_COLUMNS = ("id", "kind", "state", "scene", "progress", "created", "reason")


def _with_client(command: Callable[..., None]) -> Callable[..., None]:
    """Make a command of a function that takes a `client` first: with the options of its connection."""
    hints = get_type_hints(command, localns={"JobClient": Any}, include_extras=True)  # imported when a command runs
    own = [
        parameter.replace(annotation=hints[name], kind=parameter.KEYWORD_ONLY)
        for name, parameter in inspect.signature(command).parameters.items()
        if name != "client"
    ]

    @wraps(command)
    def run(
        *,
        server: str,
        api_key: str | None,
        ca: Path | None,
        client_certificate: Path | None,
        client_key: Path | None,
        **given: Any,
    ) -> None:
        from ...core.job_client import JobClient
        from ...tls.client import client_context, exposes_key

        client = JobClient(server, api_key, client_context(ca, client_certificate, client_key))
        if api_key is not None and exposes_key(server):
            typer.secho(
                f"warning: the API key travels unencrypted to {server}, and whoever is on the way can read it",
                fg=typer.colors.YELLOW,
                err=True,
            )
        command(client, **given)

    return with_parameters(run, [*own, *_CONNECTION])


@jobs_app.command("list")
@_with_client
def list_jobs(
    client: JobClient,
    state: Annotated[
        str, typer.Option(help="Only queued, running, succeeded, failed or cancelled ones.", show_default="all")
    ] = "",
    kind: Annotated[str, typer.Option(help=f"Only {' or '.join(KINDS)} ones.", show_default="all")] = "",
    limit: Annotated[int, typer.Option(min=1, help="How many at most.")] = 20,
    json: Annotated[bool, typer.Option("--json", help="A JSON list, for scripts.")] = False,
) -> None:
    """List the jobs, newest first."""
    jobs = client.jobs(state=state, kind=kind, limit=limit)
    if json:
        typer.echo(json_text.dumps(jobs, indent=2))
    else:
        _print_jobs(jobs)


@jobs_app.command()
@_with_client
def watch(client: JobClient, job: JobArgument) -> None:
    """Follow a job to its end. Exit code 0: it succeeded, 3: it failed, 4: it was cancelled."""
    from .watch import follow

    follow(client, job)


@jobs_app.command()
@_with_client
def cancel(client: JobClient, job: JobArgument) -> None:
    """Stop a job."""
    cancelled = client.cancel(job)
    typer.echo(f"{cancelled['id']} {cancelled['state']}")


@jobs_app.command()
@_with_client
def retry(client: JobClient, job: JobArgument) -> None:
    """Put a new job in place of a failed or cancelled one; it goes on from the last checkpoint."""
    typer.echo(client.retry(job)["id"])


@jobs_app.command()
@_with_client
def delete(client: JobClient, job: JobArgument) -> None:
    """Remove a finished job and its files; the scene that it trained stays."""
    client.delete(job)
    typer.echo(f"{job} deleted")


@jobs_app.command()
@_with_client
def logs(
    client: JobClient,
    job: JobArgument,
    max_bytes: Annotated[int, typer.Option("--bytes", min=1, max=2**20, help="How much of its end.")] = 65536,
) -> None:
    """Print the end of a job's log."""
    typer.echo(client.log(job, max_bytes), nl=False)


@jobs_app.command()
@_with_client
def download(
    client: JobClient,
    job: JobArgument,
    name: Annotated[str, typer.Argument(help="One of the job's artifacts.", show_default=False)],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write.", show_default="NAME, here")
    ] = None,
) -> None:
    """Download a file that a job made."""
    from ..output import check_writable

    path = Path(Path(name).name) if output is None else output
    check_writable(path)
    client.download(job, name, path)
    typer.echo(f"wrote {path}: {path.stat().st_size:,} bytes")


def _submit(
    client: JobClient,
    kind: str,
    specification: dict[str, Any],
    *,
    request_id: Annotated[
        str | None,
        typer.Option(help="A name of your own: given again, it gives the same job.", show_default=False),
    ] = None,
    priority: Annotated[int, typer.Option(min=-1000, max=1000, help="Higher ones go first.")] = 0,
    private: Annotated[
        bool, typer.Option("--private", help="Others see neither the job nor the scene that it makes.")
    ] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Follow the job to its end, as `jobs watch` does.")] = False,
) -> None:
    from .watch import follow

    beside = {"request_id": request_id, "priority": priority, "private": private}
    job, _ = client.submit({"kind": kind, "specification": specification, **beside})
    typer.echo(job["id"])
    if wait:
        follow(client, job["id"])


def _add_submit_command(kind: str, cls: type[Specification]) -> None:
    """`jobs submit KIND`, with an option for each field of the specification."""
    hints = get_type_hints(_submit, localns={"JobClient": Any}, include_extras=True)
    common = [
        parameter.replace(annotation=hints[parameter.name])
        for parameter in inspect.signature(_submit).parameters.values()
        if parameter.kind is parameter.KEYWORD_ONLY
    ]

    def submit(client: JobClient, **given: Any) -> None:
        values = values_of(cls, given)
        if {"sampler", "poses"} <= given.keys() and not {"sampler", "poses"} & values.keys():
            values["sampler"] = TrainingSampler()
        document = {name: _as_json(value) for name, value in values.items()}
        _submit(client, kind, document, **{parameter.name: given[parameter.name] for parameter in common})

    summary = inspect.getdoc(cls) or ""
    command = _with_client(with_parameters(submit, [*parameters_of(cls), *common]))
    submit_app.command(kind, help=summary.split("\n\n")[0])(command)


def _as_json(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else to_dict(value, with_none=False)


for _kind, _class in Specification.members.items():
    _add_submit_command(_kind, _class)


def _print_jobs(jobs: list[dict[str, Any]]) -> None:
    from ..output import print_table
    from .watch import amount

    print_table(_COLUMNS, [_row(job, amount(job)) for job in jobs])


def _row(job: dict[str, Any], progress: str) -> tuple[str, ...]:
    created = str(job["created_at"])[:19].replace("T", " ")
    scene = str(job["specification"].get("scene", ""))
    return (job["id"], job["kind"], job["state"], scene, progress, created, job["reason"] or "")
