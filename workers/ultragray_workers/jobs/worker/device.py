"""The device of a job: which one, and one job at a time on it, whichever workers of a host share an artifact folder."""

from __future__ import annotations

import fcntl
import re
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch

from .job_run import JobRun, Stopped

LOCK_FOLDER = "workers"  # of the artifact folder, which several hosts may share
_POLL_INTERVAL_S = 0.2


@contextmanager
def device_for(job_run: JobRun, asked: str = "auto") -> Iterator[str]:
    """The device of a job, held alone: its own wish, else its worker's, else a GPU where there is one.

    Also sets the number of torch's threads. Raises Stopped where the job is to stop meanwhile.
    """
    torch.set_num_threads(job_run.request.threads)
    device = job_run.request.device if asked == "auto" else asked
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    with device_alone(job_run, device):
        yield device


@contextmanager
def device_alone(job_run: JobRun, device: str) -> Iterator[None]:
    """Holds `device` (cpu, cuda or cuda:N) as soon as no other job of this host does; until then the job waits for it.

    Raises Stopped where the job is to stop meanwhile.
    """
    path = lock_path(job_run.folder.artifact_folder, device)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        is_announced = False
        while not _is_locked(file.fileno()):
            if not is_announced:
                sys.stderr.write(f"waits for {device}: another job of this host is at work on it\n")
                sys.stderr.flush()
                job_run.report(replace(job_run.progress, waits_for=device))
                is_announced = True
            if job_run.should_stop():
                raise Stopped
            time.sleep(_POLL_INTERVAL_S)
        if is_announced:
            job_run.report(replace(job_run.progress, waits_for=None))
        job_run.progress = replace(job_run.progress, waits_for=None)  # a process that was killed may have left it
        yield


def lock_path(artifact_folder: Path, device: str) -> Path:
    """The file that is locked: of this host and of the device itself, by whatever number a process knows it."""
    host = re.sub(r"[^A-Za-z0-9.-]", "-", socket.gethostname()) or "host"
    return artifact_folder / LOCK_FOLDER / f"{host}.{_device_name(device)}.device"


def _device_name(device: str) -> str:
    if device == "cpu":
        return device
    index = int(device.partition(":")[2] or 0)
    if not torch.cuda.is_available() or index >= torch.cuda.device_count():
        return f"cuda-{index}"  # the work itself refuses it
    return f"gpu-{torch.cuda.get_device_properties(index).uuid}"


def _is_locked(descriptor: int) -> bool:
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
