"""`ultragray jobs …`: training, batch rendering and the other kinds of jobs on a running service."""

from __future__ import annotations

import contextlib
import inspect
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ultragray.contract import to_dict
from ultragray.exchange.batches import names_in
from ultragray.samplers import TrainingSampler
from ultragray_service.cli.app import INTERRUPTED
from ultragray_service.cli.connection import Connection, Resource, route, with_connection
from ultragray_service.cli.options import parameters_in, parameters_of, values_of, with_parameters
from ultragray_service.cli.terminal import (
    Columns,
    Force,
    Json,
    argument,
    check_file,
    command_group,
    counted,
    examples,
    minutes_and_seconds,
    option,
    output_option,
    progress_bars,
    tell,
    tell_table,
    to_json,
    transferred,
    warn,
)
from ultragray_workers.errors import NotReady
from ultragray_workers.jobs.kinds import KINDS, Specification

command_app = command_group("Work in the background, on a running service: it goes on when this command ends.")
submit_app = command_group("Put a job into the queue; its id is printed.")
command_app.add_typer(submit_app, name="submit")

QUEUE = "Queue"
_SUBMITS = {
    "train": (
        "ultragray jobs submit train liver --scene liver --preset best --wait",
        "ultragray jobs submit train liver --scene liver --device cuda --min-memory-gb 16 --require site=lab1",
    ),
    "compare": ("ultragray jobs submit compare liver --methods scene,median,linear --wait",),
    "evaluate": ("ultragray jobs submit evaluate liver --scene liver --wait",),
    "live": ("ultragray jobs submit live liver --scene liver-live",),
    "motion": (
        "ultragray jobs submit motion liver --into liver-breathing --dataset liver --numbers $(paste -sd, belt.csv)",
        "ultragray jobs submit motion liver --into inhaled --field inhale.nrrd --field-leads from-rest --wait",
        "ultragray jobs submit motion liver --into liver-breathing --chest-mm 8 --wait",
    ),
    "render": (
        "ultragray jobs submit render liver --format hdf5 --sampler around --count 5000 --translation-mm 3",
        "ultragray jobs submit render liver --sampler around --count 10000000 --height 64 --width 64 --wait",
    ),
    "voxelize": ("ultragray jobs submit voxelize liver --field labels --format nrrd --spacing-mm 0.5 --wait",),
}
JOB_FAILED = 3  # the exit code of a command that watched a job fail
JOB_CANCELLED = 4
_FINAL_STATES = ("succeeded", "failed", "cancelled")
_METRICS_IN_A_LINE = 6
_RETRY_S = 1.0
_HELD_S = 5.0  # a connection that lasted so long was one to a service that works
_GONE_S = 60.0  # a service that comes back within this time is asked again
_COLUMNS: Columns = {
    "id": lambda job: str(job["id"]),
    "kind": lambda job: str(job["kind"]),
    "state": lambda job: str(job["state"]),
    "scene or dataset": lambda job: str(job["specification"].get("scene", job["specification"].get("dataset", ""))),
    "progress": lambda job: amount(job),
    "created": lambda job: str(job["created_at"])[:19].replace("T", " "),
    "reason": lambda job: job["reason"] or "",
}

_jobs = Resource(command_app, "jobs", "7f3c2a", _COLUMNS, "JOB", "Id of the job.")
JobArgument = Annotated[str, argument("Id of the job.", metavar="JOB")]


@command_app.command(
    "list", epilog=examples("ultragray jobs list", "ultragray jobs list --state failed --json | jq -r '.[].id'")
)
@with_connection
def list_jobs(
    connection: Connection,
    state: Annotated[str, option("Only queued, running, succeeded, failed or cancelled ones.", shown="all")] = "",
    kind: Annotated[str, option(f"Only {' or '.join(KINDS)} ones.", shown="all")] = "",
    limit: Annotated[int, option("How many at most.", min=1)] = 20,
    json: Json = False,
) -> None:
    """List the jobs, newest first."""
    tell_table(_COLUMNS, connection.listed("/v1/jobs", "jobs", limit, state=state, kind=kind), as_json=json)


_jobs.add_show("Print all that is known about a job.", "ultragray jobs show 7f3c2a --json | jq .metrics")


@command_app.command(epilog=examples("ultragray jobs watch 7f3c2a"))
@with_connection
def watch(connection: Connection, job: JobArgument, json: Json = False) -> None:
    """Follow a job to its end. Exit code 0: it succeeded, 3: it failed, 4: it was cancelled."""
    follow(connection, job, as_json=json)


_jobs.add_action("cancel", "Stop a job.", lambda job: f"{job['id']} {job['state']}")
_jobs.add_action(
    "retry",
    "Put a new job in place of a failed or cancelled one; it goes on from the last checkpoint.",
    lambda job: str(job["id"]),
)
_jobs.add_delete("Remove a finished job and its files; the scene that it trained stays.")


@command_app.command(epilog=examples("ultragray jobs logs 7f3c2a --bytes 4096"))
@with_connection
def logs(
    connection: Connection,
    job: JobArgument,
    max_bytes: Annotated[int, option("How much of its end.", "--bytes", min=1, max=2**20)] = 65536,
    json: Json = False,
) -> None:
    """Print the end of a job's log."""
    log = connection.text(route("jobs", job, suffix=f"/log?max_bytes={max_bytes}"))
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
    name: Annotated[str, argument("One of the job's artifacts, or a range of them.")],
    output: Annotated[Path | None, output_option("File to write; of a range the folder.", default="NAME, here")] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Download a file that a job made."""
    if len(names := list(names_in(name))) > 1:
        _download_all(connection, job, names, Path() if output is None else output, as_json=json, force=force)
        return
    path = Path(Path(name).name) if output is None else output
    check_file(path, force=force)
    with transferred(f"downloading {name}") as begin:
        size = connection.download(route("jobs", job, "artifacts", name), path, begin)
    tell(f"wrote {path}: {size:,} bytes", {"output": str(path), "bytes": size}, as_json=json)


def _download_all(
    connection: Connection, job: str, names: list[str], folder: Path, *, as_json: bool, force: bool
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    missing = [name for name in names if force or not (folder / Path(name).name).exists()]
    size = 0
    with counted(f"downloading {len(missing):,} files", len(missing)) as report:
        for number, name in enumerate(missing, 1):
            to = folder / Path(name).name
            size += connection.download(route("jobs", job, "artifacts", name), to, lambda total: lambda count: None)
            report(number)
    document = {"output": str(folder), "files": len(missing), "there_before": len(names) - len(missing), "bytes": size}
    tell(f"wrote {len(missing):,} files to {folder}: {size:,} bytes", document, as_json=as_json)


def _submit(
    connection: Connection,
    kind: str,
    specification: dict[str, Any],
    *,
    request_id: Annotated[
        str | None, option("A name of your own: given again, it gives the same job.", shown=False, panel=QUEUE)
    ] = None,
    priority: Annotated[int, option("Higher ones go first.", min=-1000, max=1000, panel=QUEUE)] = 0,
    private: Annotated[
        bool, option("Others see neither the job nor the scene that it makes.", "--private", panel=QUEUE)
    ] = False,
    wait: Annotated[bool, option("Follow the job to its end, as `jobs watch` does.", "--wait", panel=QUEUE)] = False,
    json: Json = False,
) -> None:
    beside = {"request_id": request_id, "priority": priority, "private": private}
    job = connection.json("POST", "/v1/jobs", {"kind": kind, "specification": specification, **beside})
    if wait and json:
        follow(connection, job["id"], as_json=True)
        return
    if job["progress"]["waits_for"] is not None:
        warn(f"{job['id']} waits for {job['progress']['waits_for']}")
    tell(job["id"], job, as_json=json)
    if wait:
        follow(connection, job["id"], as_json=False)


def _add_submit_command(kind: str, cls: type[Specification]) -> None:
    common = [one for one in parameters_in(_submit) if one.name not in ("connection", "kind", "specification")]

    def submit(connection: Connection, **options: Any) -> None:
        values = values_of(cls, options)
        if {"sampler", "poses"} <= options.keys() and not {"sampler", "poses"} & values.keys():
            values["sampler"] = TrainingSampler()
        document = {name: _as_json(value) for name, value in values.items()}
        _submit(connection, kind, document, **{parameter.name: options[parameter.name] for parameter in common})

    summary = inspect.getdoc(cls) or ""
    command = with_connection(with_parameters(submit, [*parameters_of(cls), *common]))
    submit_app.command(kind, help=summary.split("\n\n")[0], epilog=examples(*_SUBMITS.get(kind, ())))(command)


def _as_json(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else to_dict(value, with_none=False)


for _kind, _class in Specification.members.items():
    _add_submit_command(_kind, _class)


def follow(connection: Connection, job_id: str, *, as_json: bool = False) -> None:
    """Return when the job has succeeded; exit with 3 where it failed, 4 where it was cancelled, 130 at Ctrl-C."""
    try:
        with _display(job_id) as show:
            job = _watched(connection, job_id, show)
    except KeyboardInterrupt:
        typer.echo(f"job {job_id} goes on; `ultragray jobs cancel {job_id}` stops it", err=True)
        raise typer.Exit(INTERRUPTED) from None
    if job["state"] == "succeeded":
        tell(f"{job_id} succeeded{results(job)}", job, as_json=as_json)
        return
    if as_json:
        tell("", job, as_json=True)
    if job["state"] == "failed":
        typer.secho(f"error: {job_id} failed: {job['reason']}", fg=typer.colors.RED, err=True)
        raise typer.Exit(JOB_FAILED)
    typer.echo(f"{job_id} was cancelled", err=True)
    raise typer.Exit(JOB_CANCELLED)


def _watched(connection: Connection, job_id: str, show: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """The job in its final state; a service that was restarted in the meantime is asked again."""
    connection.json("GET", route("jobs", job_id))  # nobody there, or no such job: said at once
    contact_s = time.monotonic()
    while True:
        request_s, gone = time.monotonic(), NotReady(f"nothing is heard of the job {job_id}")
        try:
            for event in connection.events(route("jobs", job_id, "events"), "progress"):
                job: dict[str, Any] = event
                show(job)
                if job["state"] in _FINAL_STATES:
                    return job
        except NotReady as error:
            gone = error
        if (now := time.monotonic()) - request_s > _HELD_S:
            contact_s = now  # the service was there until now, though perhaps nothing changed
        elif now - contact_s > _GONE_S:
            raise gone
        time.sleep(_RETRY_S)


@contextlib.contextmanager
def _display(job_id: str) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A bar on a terminal's stderr; elsewhere a line for every change of state and every tenth of the work."""
    last: tuple[str, int] | None = None
    with progress_bars("{task.description}", "bar", "of", "{task.fields[figures]}") as bar:
        task = bar.add_task(f"{job_id}", total=None, figures="")

        def show(job: dict[str, Any]) -> None:
            nonlocal last
            done, of, _ = work_done(job)
            if not bar.disable:
                bar.update(task, description=f"{job_id} {job['state']}", completed=done, total=of, figures=figures(job))
                return
            current = (job["state"], done * 10 // of if of else 0)
            if current != last:
                last = current
                sys.stderr.write(" ".join(filter(None, (job_id, job["state"], amount(job), figures(job)))) + "\n")

        yield show


def work_done(job: dict[str, Any]) -> tuple[int, int | None, str]:
    """Steps or frames that are done, how many there are (None: not known yet), and which of the two."""
    progress = job["progress"]
    done, of = ("frames_done", "frames") if progress["steps"] is None else ("step", "steps")
    return progress[done] or 0, progress[of], of


def amount(job: dict[str, Any]) -> str:
    """Such as "120 of 500 steps"; empty where it is not known yet."""
    done, of, unit = work_done(job)
    return "" if of is None else f"{done:,} of {of:,} {unit}"


def figures(job: dict[str, Any]) -> str:
    formats: dict[str, Callable[[Any], str]] = {
        "waits_for": "waits for {}".format,
        "method": lambda method: f"{method}, method {progress['method_number']} of {progress['methods']}",
        "loss": "loss {:.4f}".format,
        "gaussians": "{:,} Gaussians".format,
        "rate_per_s": "{:.1f}/s".format,
        "seconds_left": lambda left_s: f"{minutes_and_seconds(left_s)} left",
        "val_psnr_db": "held out {:.2f} dB".format,
    }
    progress = job["progress"]
    return " · ".join(words(progress[name]) for name, words in formats.items() if progress[name] is not None)


def results(job: dict[str, Any]) -> str:
    """Metrics and artifacts, for the end of a line; more metrics than one reads in a line stand below it."""
    metrics = [f"{name} {value:.4g}" for name, value in job["metrics"].items()]
    artifacts = f"; artifacts: {', '.join(job['artifacts'])}" if job["artifacts"] else ""
    if len(metrics) > _METRICS_IN_A_LINE:
        return "".join((artifacts, *(f"\n  {metric}" for metric in metrics)))
    return f"; {', '.join(metrics)}{artifacts}" if metrics else artifacts
