"""The inside of a helper process: one piece of work apart from the service, slow to others, of limited memory.

It reads one JSON object from stdin and writes one to stdout: `{}`, or the `reason`, `detail` and `field` of an error.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ultragray.errors import MemoryExceeded, UltragrayError

from ..datasets.incoming import storage_full

PROGRESS_NAME = "progress"  # in the folder that a process fills
NICE_LEVEL = 10
_PR_SET_PDEATHSIG = 1


def answer_request(work: Callable[[dict[str, Any]], None]) -> None:
    """Does the work of the request on stdin, whose key `memory_bytes` limits it. The process ends with its parent."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    os.nice(NICE_LEVEL)
    request = json.loads(sys.stdin.buffer.read())
    resource.setrlimit(resource.RLIMIT_DATA, (request["memory_bytes"], request["memory_bytes"]))
    answer: dict[str, str | None] = {}
    try:
        with storage_full("it"):
            work(request)
    except (MemoryError, RuntimeError, UltragrayError) as caught:
        error = _in_words(caught, request["memory_bytes"])
        answer = {"reason": error.reason, "detail": error.detail, "field": error.field}
    sys.stdout.write(json.dumps(answer))


def tell_progress(folder: Path, share: float) -> None:
    """Tells which share of the work, from 0 to 1, is done."""
    temporary = folder / f"{PROGRESS_NAME}.new"
    temporary.write_text(str(share), encoding="utf-8")
    temporary.replace(folder / PROGRESS_NAME)


def _in_words(error: Exception, memory_bytes: int) -> UltragrayError:
    if isinstance(error, UltragrayError):
        return error
    if isinstance(error, RuntimeError) and "allocate memory" not in str(error):
        raise error
    return MemoryExceeded(f"it takes more than {memory_bytes >> 20} MiB (ULTRAGRAY_DATASET_MEMORY_MB of the service)")
