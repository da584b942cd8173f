"""The inside of a helper process: one piece of work apart from the service, slow to others, of limited memory.

It reads one JSON object from stdin (`arguments` of the work, `memory_bytes`, and `what` it does, as errors say it) and
writes one to stdout: `{}`, or the `reason`, `detail` and `field` of an error. Free of torch, as the module of any work
must be until the work begins.
"""

from __future__ import annotations

import json
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from ultragray.errors import MemoryExceeded, UltragrayError
from ultragray_workers.claims import storage_full
from ultragray_workers.niceness import let_frames_go_first
from ultragray_workers.parent import end_with_parent

PROGRESS_NAME = "progress"  # in the folder that a process fills
NICE_LEVEL = 10


def answer_request(work: Callable[..., None]) -> None:
    """Do the work with the arguments on stdin. The process ends with its parent."""
    end_with_parent(signal.SIGKILL)
    let_frames_go_first(NICE_LEVEL)
    request = json.loads(sys.stdin.buffer.read())
    memory_bytes, what = request["memory_bytes"], request["what"]
    resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))
    answer: dict[str, str | None] = {}
    try:
        try:
            with storage_full("it"):
                work(**request["arguments"])
        except (MemoryError, RuntimeError) as error:  # RuntimeError: how torch tells it
            if isinstance(error, RuntimeError) and "allocate memory" not in str(error):
                raise
            limit = f"{memory_bytes >> 20} MiB (ULTRAGRAY_DATASET_MEMORY_MB of the service)"
            raise MemoryExceeded(f"{what} takes more than {limit}") from None
    except UltragrayError as error:
        answer = {"reason": error.reason, "detail": error.detail, "field": error.field}
    sys.stdout.write(json.dumps(answer))


def write_progress(folder: Path, share: float) -> None:
    """Say which share of the work, from 0 to 1, is done."""
    temporary = folder / f"{PROGRESS_NAME}.new"
    temporary.write_text(str(share), encoding="utf-8")
    temporary.replace(folder / PROGRESS_NAME)
