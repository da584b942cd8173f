"""The process of a job: started, ended with a checkpoint, and never left behind."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.worker.device import DeviceLock
from ultragray_workers.jobs.worker.processes import holder_of, kill_group

STOP_WAIT_S = 10.0  # for the checkpoint of a training that is to stop
_KILL_WAIT_S, _KILL_POLL_S = 5.0, 0.02


@contextmanager
def job_process(
    folder: JobFolder, device: DeviceLock, threads: int, descriptors: Sequence[int] = ()
) -> Iterator[subprocess.Popen[bytes]]:
    """A process at work in the folder, which shares the lock of its device; killed with its group at the end.

    `descriptors`: its end of a channel to this worker; this process has it no more.
    """
    with folder.log.open("ab") as log:
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "ultragray_workers.jobs.worker.run_job", str(folder.path), str(os.getpid())),
                *map(str, descriptors),
            ],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
                "OMP_NUM_THREADS": str(threads),
                "OPENBLAS_NUM_THREADS": str(threads),
            },
            start_new_session=True,
            pass_fds=[device.fileno(), *descriptors],
        )
    for descriptor in descriptors:
        os.close(descriptor)
    try:
        yield process
    finally:
        kill_group(process.pid)
        process.wait()


def end_with_checkpoint(process: subprocess.Popen[bytes]) -> None:
    """Asks a process to write a checkpoint and end, and waits for a while."""
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(STOP_WAIT_S)


def end_process_of_another_worker(folder: JobFolder) -> None:
    """Kills the process of a worker of this host that has lost the job, but lives or was stopped."""
    end_s = time.monotonic() + _KILL_WAIT_S
    while (holder := holder_of(folder.lock)) is not None and time.monotonic() < end_s:
        kill_group(holder[0])
        time.sleep(_KILL_POLL_S)
