"""Following a job on the command line: a bar on a terminal, lines elsewhere, and an exit code by how it ended."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import typer

from ultragray_service.cli.app import INTERRUPTED
from ultragray_service.cli.terminal import tell
from ultragray_service.remote.jobs import Jobs
from ultragray_workers.errors import NotReady

JOB_FAILED = 3  # the exit code of a command that watched a job fail
JOB_CANCELLED = 4
_FINAL_STATES = ("succeeded", "failed", "cancelled")
_METRICS_IN_A_LINE = 6
_RETRY_S = 1.0
_HELD_S = 5.0  # a connection that lasted so long was one to a service that works
_GONE_S = 60.0  # a service that comes back within this time is asked again


def follow(jobs: Jobs, job_id: str, *, as_json: bool = False) -> None:
    """Return when the job has succeeded; exit with 3 where it failed, 4 where it was cancelled, 130 at Ctrl-C.

    Raises UltragrayError: no such job, or a service that stays away.
    """
    try:
        with _display(job_id) as show:
            job = _watched(jobs, job_id, show)
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


def _watched(jobs: Jobs, job_id: str, show: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """The job in its final state; a service that was restarted in the meantime is asked again."""
    jobs.get(job_id)  # nobody there, or no such job: said at once
    seen = time.monotonic()
    while True:
        asked, gone = time.monotonic(), NotReady(f"nothing is heard of the job {job_id}")
        try:
            for job in jobs.changes(job_id):
                show(job)
                if job["state"] in _FINAL_STATES:
                    return job
        except NotReady as error:
            gone = error
        if (now := time.monotonic()) - asked > _HELD_S:
            seen = now  # the service was there until now, though perhaps nothing changed
        elif now - seen > _GONE_S:
            raise gone
        time.sleep(_RETRY_S)


@contextlib.contextmanager
def _display(job_id: str) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A bar on a terminal's stderr; elsewhere a line for every change of state and every tenth of the work."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[figures]}"),
    )
    last: tuple[str, int] | None = None
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(f"{job_id}", total=None, figures="")

        def show(job: dict[str, Any]) -> None:
            nonlocal last
            done, of, _ = work_done(job)
            if console.is_terminal:
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
    """The figures of the progress that are known, in short."""
    progress = job["progress"]
    parts = []
    if progress["waits_for"] is not None:
        parts.append(f"waits for {progress['waits_for']}")
    if progress["method"] is not None:
        parts.append(f"{progress['method']}, method {progress['method_number']} of {progress['methods']}")
    if progress["loss"] is not None:
        parts.append(f"loss {progress['loss']:.4f}")
    if progress["gaussians"] is not None:
        parts.append(f"{progress['gaussians']:,} Gaussians")
    if progress["rate_per_s"] is not None:
        parts.append(f"{progress['rate_per_s']:.1f}/s")
    if progress["seconds_left"] is not None:
        minutes, seconds = divmod(round(progress["seconds_left"]), 60)
        parts.append(f"{minutes}:{seconds:02d} left")
    if progress["val_psnr_db"] is not None:
        parts.append(f"held out {progress['val_psnr_db']:.2f} dB")
    return " · ".join(parts)


def results(job: dict[str, Any]) -> str:
    """Metrics and artifacts, for the end of a line; more metrics than one reads in a line stand below it."""
    metrics = [f"{name} {value:.4g}" for name, value in job["metrics"].items()]
    artifacts = f"; artifacts: {', '.join(job['artifacts'])}" if job["artifacts"] else ""
    if len(metrics) > _METRICS_IN_A_LINE:
        return "".join((artifacts, *(f"\n  {metric}" for metric in metrics)))
    return f"; {', '.join(metrics)}{artifacts}" if metrics else artifacts
