"""Work that would block the event loop: in a thread of its own, or in a helper process with bounded memory."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from contextvars import copy_context
from functools import partial
from typing import Any, TypeVar

from ultragray.errors import MemoryExceeded, UltragrayError, error_classes
from ultragray_workers import helpers as helper
from ultragray_workers.errors import DeadlineExceeded

T = TypeVar("T")


async def in_own_thread(work: Callable[[], T]) -> T:
    """Do `work` in the caller's context: what is hidden from the caller is not found.

    Cancelling the caller leaves the thread to its work; it ends with the process.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def run() -> None:
        try:
            result = work()
        except BaseException as error:
            tell(partial(done.set_exception, error))
        else:
            tell(partial(done.set_result, result))

    def tell(outcome: Callable[[], None]) -> None:
        with suppress(RuntimeError):  # the loop is closed: nobody waits
            loop.call_soon_threadsafe(lambda: None if done.done() else outcome())

    threading.Thread(target=copy_context().run, args=(run,), daemon=True).start()
    return await done


async def to_its_end(work: Callable[[], T]) -> T:
    """Do `work` in a thread of its own. A cancelled caller still waits for its end."""
    working = asyncio.ensure_future(in_own_thread(work))
    try:
        return await asyncio.shield(working)
    finally:
        await asyncio.wait({working})


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
