"""`ultragray jobs …`: training, batch rendering and the other kinds of jobs on a running service."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import numpy as np
import typer

from ultragray.contract import to_dict
from ultragray.exchange.batches import names_in
from ultragray.samplers import TrainingSampler
from ultragray_service.cli.options import parameters_of, values_of, with_parameters
from ultragray_service.cli.remote.connection import with_connection
from ultragray_service.cli.scenes import print_facts
from ultragray_service.cli.terminal import (
    Force,
    Json,
    check_file,
    command_group,
    counted,
    examples,
    output_option,
    print_table,
    tell,
    to_json,
    transferred,
    warn,
)
from ultragray_workers.jobs.kinds import KINDS, Specification

if TYPE_CHECKING:
    from ultragray_service.remote.connection import Connection
    from ultragray_service.remote.jobs import Jobs

command_app = command_group("Work in the background, on a running service: it goes on when this command ends.")
submit_app = command_group("Put a job into the queue; its id is printed.")
command_app.add_typer(submit_app, name="submit")

JobArgument = Annotated[str, typer.Argument(help="Id of the job.", show_default=False)]
QUEUE = "Queue"
_SUBMITS = {
    "train": (
        "ultragray jobs submit train liver --scene liver --preset best --wait",
        "ultragray jobs submit train liver --scene liver --device cuda --min-memory-gb 16 --require site=lab1",
    ),
    "compare": ("ultragray jobs submit compare liver --methods scene,median,linear --wait",),
    "evaluate": ("ultragray jobs submit evaluate liver --scene liver --wait",),
    "render": (
        "ultragray jobs submit render liver --format hdf5 --sampler around --count 5000 --translation-mm 3",
        "ultragray jobs submit render liver --sampler around --count 10000000 --height 64 --width 64 --wait",
    ),
    "voxelize": ("ultragray jobs submit voxelize liver --field labels --format nrrd --spacing-mm 0.5 --wait",),
}
_COLUMNS = ("id", "kind", "state", "scene or dataset", "progress", "created", "reason")


@command_app.command(
    "list", epilog=examples("ultragray jobs list", "ultragray jobs list --state failed --json | jq -r '.[].id'")
)
@with_connection
def list_jobs(
    connection: Connection,
    state: Annotated[
        str, typer.Option(help="Only queued, running, succeeded, failed or cancelled ones.", show_default="all")
    ] = "",
    kind: Annotated[str, typer.Option(help=f"Only {' or '.join(KINDS)} ones.", show_default="all")] = "",
    limit: Annotated[int, typer.Option(min=1, help="How many at most.")] = 20,
    json: Json = False,
) -> None:
    """List the jobs, newest first."""
    from ultragray_service.remote.jobs import Jobs

    jobs = Jobs(connection).newest(state=state, kind=kind, limit=limit)
    if json:
        typer.echo(to_json(jobs))
    else:
        _print_jobs(jobs)


@command_app.command(epilog=examples("ultragray jobs show 7f3c2a", "ultragray jobs show 7f3c2a --json | jq .metrics"))
@with_connection
def show(connection: Connection, job: JobArgument, json: Json = False) -> None:
    """Print all that is known about a job."""
    from ultragray_service.remote.jobs import Jobs

    found = Jobs(connection).get(job)
    if json:
        typer.echo(to_json(found))
    else:
        print_facts(found)


@command_app.command(epilog=examples("ultragray jobs watch 7f3c2a"))
@with_connection
def watch(connection: Connection, job: JobArgument, json: Json = False) -> None:
    """Follow a job to its end. Exit code 0: it succeeded, 3: it failed, 4: it was cancelled."""
    from ultragray_service.cli.remote.watch import follow
    from ultragray_service.remote.jobs import Jobs

    follow(Jobs(connection), job, as_json=json)


@command_app.command(epilog=examples("ultragray jobs cancel 7f3c2a"))
@with_connection
def cancel(connection: Connection, job: JobArgument, json: Json = False) -> None:
    """Stop a job."""
    from ultragray_service.remote.jobs import Jobs

    cancelled = Jobs(connection).cancel(job)
    tell(f"{cancelled['id']} {cancelled['state']}", cancelled, as_json=json)


@command_app.command(epilog=examples("ultragray jobs retry 7f3c2a"))
@with_connection
def retry(connection: Connection, job: JobArgument, json: Json = False) -> None:
    """Put a new job in place of a failed or cancelled one; it goes on from the last checkpoint."""
    from ultragray_service.remote.jobs import Jobs

    again = Jobs(connection).retry(job)
    tell(again["id"], again, as_json=json)


@command_app.command(epilog=examples("ultragray jobs delete 7f3c2a"))
@with_connection
def delete(connection: Connection, job: JobArgument, json: Json = False) -> None:
    """Remove a finished job and its files; the scene that it trained stays."""
    from ultragray_service.remote.jobs import Jobs

    Jobs(connection).delete(job)
    tell(f"{job} deleted", {"deleted": job}, as_json=json)


@command_app.command(epilog=examples("ultragray jobs logs 7f3c2a --bytes 4096"))
@with_connection
def logs(
    connection: Connection,
    job: JobArgument,
    max_bytes: Annotated[int, typer.Option("--bytes", min=1, max=2**20, help="How much of its end.")] = 65536,
    json: Json = False,
) -> None:
    """Print the end of a job's log."""
    from ultragray_service.remote.jobs import Jobs

    log = Jobs(connection).log(job, max_bytes)
    if json:
        typer.echo(to_json({"job": job, "log": log}))
    else:
        typer.echo(log, nl=False)


@command_app.command(
    epilog=examples(
        "ultragray jobs download 7f3c2a frames.npz -o frames.npz",
        "ultragray jobs download 7f3c2a 'frames-{000000..000199}.tar' -o frames/  # those that are not there yet",
    )
)
@with_connection
def download(
    connection: Connection,
    job: JobArgument,
    name: Annotated[str, typer.Argument(help="One of the job's artifacts, or a range of them.", show_default=False)],
    output: Annotated[Path | None, output_option("File to write; of a range the folder.", default="NAME, here")] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Download a file that a job made."""
    from ultragray_service.remote.jobs import Jobs

    if len(names := list(names_in(name))) > 1:
        _download_all(Jobs(connection), job, names, Path() if output is None else output, as_json=json, force=force)
        return
    path = Path(Path(name).name) if output is None else output
    check_file(path, force=force)
    with transferred(f"downloading {name}") as begin:
        size = Jobs(connection).download(job, name, path, begin)
    tell(f"wrote {path}: {size:,} bytes", {"output": str(path), "bytes": size}, as_json=json)


def _download_all(jobs: Jobs, job: str, names: list[str], folder: Path, *, as_json: bool, force: bool) -> None:
    """Downloads the files that are not in the folder yet, whole each."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = [name for name in names if force or not (folder / Path(name).name).exists()]
    size = 0
    with counted(f"downloading {len(missing):,} files", len(missing)) as report:
        for number, name in enumerate(missing, 1):
            size += jobs.download(job, name, folder / Path(name).name, lambda total: lambda count: None)
            report(number)
    document = {"output": str(folder), "files": len(missing), "there_before": len(names) - len(missing), "bytes": size}
    tell(f"wrote {len(missing):,} files to {folder}: {size:,} bytes", document, as_json=as_json)


def _submit(
    connection: Connection,
    kind: str,
    specification: dict[str, Any],
    *,
    request_id: Annotated[
        str | None,
        typer.Option(
            help="A name of your own: given again, it gives the same job.", show_default=False, rich_help_panel=QUEUE
        ),
    ] = None,
    priority: Annotated[
        int, typer.Option(min=-1000, max=1000, help="Higher ones go first.", rich_help_panel=QUEUE)
    ] = 0,
    private: Annotated[
        bool,
        typer.Option(
            "--private", help="Others see neither the job nor the scene that it makes.", rich_help_panel=QUEUE
        ),
    ] = False,
    wait: Annotated[
        bool, typer.Option("--wait", help="Follow the job to its end, as `jobs watch` does.", rich_help_panel=QUEUE)
    ] = False,
    json: Json = False,
) -> None:
    from ultragray_service.cli.remote.watch import follow
    from ultragray_service.remote.jobs import Jobs

    jobs = Jobs(connection)
    beside = {"request_id": request_id, "priority": priority, "private": private}
    job, _ = jobs.submit({"kind": kind, "specification": specification, **beside})
    if wait and json:
        follow(jobs, job["id"], as_json=True)
        return
    if job["progress"]["waits_for"] is not None:
        warn(f"{job['id']} waits for {job['progress']['waits_for']}")
    tell(job["id"], job, as_json=json)
    if wait:
        follow(jobs, job["id"], as_json=False)


def _add_submit_command(kind: str, cls: type[Specification]) -> None:
    """`jobs submit KIND`, with an option for each field of the specification."""
    hints = get_type_hints(_submit, localns={"Connection": Any}, include_extras=True)
    common = [
        parameter.replace(annotation=hints[parameter.name])
        for parameter in inspect.signature(_submit).parameters.values()
        if parameter.kind is parameter.KEYWORD_ONLY
    ]

    def submit(connection: Connection, **given: Any) -> None:
        values = values_of(cls, given)
        if {"sampler", "poses"} <= given.keys() and not {"sampler", "poses"} & values.keys():
            values["sampler"] = TrainingSampler()
        document = {name: _as_json(value) for name, value in values.items()}
        _submit(connection, kind, document, **{parameter.name: given[parameter.name] for parameter in common})

    summary = inspect.getdoc(cls) or ""
    command = with_connection(with_parameters(submit, [*parameters_of(cls), *common]))
    submit_app.command(kind, help=summary.split("\n\n")[0], epilog=examples(*_SUBMITS.get(kind, ())))(command)


def _as_json(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else to_dict(value, with_none=False)


for _kind, _class in Specification.members.items():
    _add_submit_command(_kind, _class)


def _print_jobs(jobs: list[dict[str, Any]]) -> None:
    from ultragray_service.cli.remote.watch import amount

    print_table(_COLUMNS, [_row(job, amount(job)) for job in jobs])


def _row(job: dict[str, Any], progress: str) -> tuple[str, ...]:
    created = str(job["created_at"])[:19].replace("T", " ")
    about = str(job["specification"].get("scene", job["specification"].get("dataset", "")))
    return (job["id"], job["kind"], job["state"], about, progress, created, job["reason"] or "")
