"""Work in a helper process (`ultragray_workers.helpers.helper`), awaited without blocking the event loop."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import subprocess
import sys
from typing import Any

from ultragray import errors
from ultragray.errors import DeadlineExceeded, MemoryExceeded, UltragrayError

from ..core.own_thread import in_own_thread

_log = logging.getLogger("ultragray.service")
_ERRORS = {
    cls.reason: cls for cls in vars(errors).values() if isinstance(cls, type) and issubclass(cls, UltragrayError)
}
PATIENCE_S = 3600.0  # of who may have to wait for the helpers of others


async def run_helper(
    module: str, request: dict[str, Any], *, what: str, timeout_s: float, killed: type[UltragrayError]
) -> None:
    """Has `ultragray_workers.<module>.main` answer a request; `what` says in errors what it does.

    Raises what the work raises, DeadlineExceeded, MemoryExceeded where the process was killed as that of a machine
    without memory is, and `killed` where something else ended it.
    """
    status, output, complaints = await _run(module, request, what, timeout_s)
    if status == -signal.SIGKILL:
        raise MemoryExceeded(f"the process of {what} was killed: the machine has probably no memory left for it")
    if status < 0:
        raise killed(f"the process of {what} was ended by signal {-status}")
    if status:
        fields = {"status": status, "stderr": complaints.decode(errors="replace")[-4000:]}
        _log.error(f"{what} failed unexpectedly", extra={"fields": fields})
        raise UltragrayError(f"{what} failed unexpectedly, see the log")
    if answer := json.loads(output):
        raise _ERRORS[answer["reason"]](answer["detail"], field=answer["field"])


async def _run(module: str, request: dict[str, Any], what: str, timeout_s: float) -> tuple[int, bytes, bytes]:
    """Status, stdout and stderr of the process, which does not outlive the wait."""
    program = f"import sys; sys.path[:] = {sys.path!r}; from ultragray_workers.{module} import main; main()"
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
        raise DeadlineExceeded(f"{what} took more than {timeout_s:g} s") from None
    finally:
        process.kill()
        await asyncio.shield(talk)
    return process.returncode, output, complaints
