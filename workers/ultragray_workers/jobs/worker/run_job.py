"""The work of a job's process, which its worker's `template` has forked.

It dies with the template, and so with its worker, works alone in the folder, and as its last act says in outcome.json
how the job ended. A job that fails is a process that ends well; SIGTERM ends it with exit code STOPPED and a checkpoint
to go on from, and files that cannot be used (a share that has gone) with FOLDER_LOST: it may be started again.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import time
import traceback
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from ultragray.errors import InvalidArgument, MemoryExceeded, UltragrayError
from ultragray_workers.claims import is_no_room, storage_full, try_lock
from ultragray_workers.jobs.folder import JobFolder
from ultragray_workers.jobs.kinds.base import from_dict
from ultragray_workers.jobs.progress import Outcome
from ultragray_workers.jobs.worker.job_run import JobRun, Stopped
from ultragray_workers.processes import end_with_parent, let_frames_go_first

STOPPED, STORAGE_FULL, FOLDER_LOST = 75, 73, 74
_LOCK_POLL_S = 0.2
_FOLDERS = re.compile(r"(?<![\w./:])/(?:[^\s/:,;'\"()]+/)+")  # of an absolute path
_OOM_SCORE_ADJ = "500"  # of 1000: where memory runs out, jobs go before the service and its workers


def main(folder_path: str, template: int) -> int:
    """The exit code: 0 where outcome.json says how the job ended."""
    end_with_parent(signal.SIGKILL)
    if os.getppid() != template:  # it died before the line above
        return STOPPED
    signals: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: signals.append(number))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    path = Path(folder_path)
    job_id, _, attempt = path.name.rpartition(".")
    folder = JobFolder(path.parent.parent, job_id, int(attempt))
    with folder.lock.open("a") as lock:
        while not try_lock(lock):  # another worker's process may still be at it, or have finished
            if signals:
                return STOPPED
            time.sleep(_LOCK_POLL_S)
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        if folder.outcome() is not None:
            return 0
        request = folder.request()
        if request is None:  # it was taken away
            return FOLDER_LOST
        let_frames_go_first(request.nice)
        Path("/proc/self/oom_score_adj").write_text(_OOM_SCORE_ADJ, encoding="ascii")
        job_run = JobRun(folder, request, lambda: bool(signals))
        try:
            outcome = _outcome_of(job_run)
            folder.write_progress(outcome.progress)
            folder.write_outcome(outcome)
        except Stopped:
            return STOPPED
        except OSError as error:
            if is_no_room(error):
                return STORAGE_FULL
            _tell_traceback()
            return FOLDER_LOST
    return 0


def _outcome_of(job_run: JobRun) -> Outcome:
    import torch  # not before the folder is this process's own

    torch.set_num_threads(job_run.request.threads)
    try:
        with storage_full("what this job writes"):
            outcome = from_dict(job_run.request.specification).run(job_run)
        return replace(outcome, progress=job_run.progress)
    except (Stopped, OSError):  # files that cannot be read or written are no fault of the job
        raise
    except UltragrayError as error:
        field = error.field if isinstance(error, InvalidArgument) else None
        prefix = f"{field}: " if field is not None and field not in error.detail else ""
        return _failed(job_run, error.reason, prefix + error.detail)
    except Exception as error:
        if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "allocate memory" in str(error)):
            return _failed(job_run, MemoryExceeded.reason, "the memory of the machine did not suffice for this job")
        _tell_traceback()
        message = " ".join(str(error).split()) or "no message"
        return _failed(
            job_run, "INTERNAL", f"the process of the job failed, see its log: {type(error).__name__}: {message}"
        )


def _tell_traceback() -> None:
    sys.stderr.write(_without_folders(traceback.format_exc()))


def _without_folders(text: str) -> str:
    """A text with absolute paths cut to their last part: callers learn no folders of the service."""
    return _FOLDERS.sub("", text)


def _failed(job_run: JobRun, error: str, reason: str) -> Outcome:
    message = _without_folders(reason.replace(f"{job_run.folder.artifact_folder}{os.sep}", ""))
    with suppress(OSError):
        sys.stderr.write(f"failed: {message}\n")
    return Outcome(error=error, reason=message, progress=job_run.progress)
