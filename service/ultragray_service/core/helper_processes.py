"""Work in helper processes (`ultragray_workers.helpers.helper`), awaited without blocking the event loop."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from ultragray.errors import MemoryExceeded, UltragrayError, error_classes
from ultragray_service.core.own_thread import in_own_thread
from ultragray_workers.errors import DeadlineExceeded
from ultragray_workers.helpers import helper

_log = logging.getLogger("ultragray.service")
PATIENCE_S = 3600.0  # of a request that waits for the processes of others


class HelperProcesses:
    """Helper processes one after another, each of at most `memory_bytes`."""

    def __init__(self, memory_bytes: int) -> None:
        self._memory_bytes = memory_bytes
        self._turn = asyncio.Lock()

    async def run(
        self,
        work: Callable[..., None],
        arguments: dict[str, Any],
        *,
        what: str,
        timeout_s: float,
        killed: type[UltragrayError],
    ) -> None:
        """Have a function of a module that needs no torch do its work in a process; `what` says it in errors.

        Raises what the work raises, DeadlineExceeded, MemoryExceeded also where the process was killed as a machine
        without memory does, and `killed` where something else ended it. Cancelling ends the process.
        """
        request = {"arguments": arguments, "memory_bytes": self._memory_bytes, "what": what}
        async with self._turn:
            status, output, complaints = await _communicate(work, request, timeout_s)
        if status == -signal.SIGKILL:
            raise MemoryExceeded(f"the process of {what} was killed: the machine has probably no memory left for it")
        if status < 0:
            raise killed(f"the process of {what} was ended by signal {-status}")
        if status:
            fields = {"status": status, "stderr": complaints.decode(errors="replace")[-4000:]}
            _log.error(f"{what} failed unexpectedly", extra={"fields": fields})
            raise UltragrayError(f"{what} failed unexpectedly, see the log")
        if answer := json.loads(output):
            error = next(cls for cls in error_classes() if cls.reason == answer["reason"])
            raise error(answer["detail"], field=answer["field"])


async def _communicate(
    work: Callable[..., None], request: dict[str, Any], timeout_s: float
) -> tuple[int, bytes, bytes]:
    """Status, stdout and stderr of the process, which does not outlive the wait."""
    program = (
        f"import sys; sys.path[:] = {sys.path!r}; from {helper.__name__} import answer_request; "
        f"from {work.__module__} import {work.__name__}; answer_request({work.__name__})"
    )
    # Not asyncio's: it forks, which gRPC complains about.
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    talk = asyncio.ensure_future(in_own_thread(lambda: process.communicate(json.dumps(request).encode())))
    try:
        output, complaints = await asyncio.wait_for(asyncio.shield(talk), timeout=timeout_s)
    except asyncio.TimeoutError:
        raise DeadlineExceeded(f"{request['what']} took more than {timeout_s:g} s") from None
    finally:
        process.kill()
        await asyncio.shield(talk)
    return process.returncode, output, complaints
