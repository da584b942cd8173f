"""The watch over a job's process: whether it gets on, and how long it may run.

Getting on is told by the kernel's account of the process, not by the job: loading a dataset, evaluating and writing an
archive take the processor or move bytes like any training step does, however long one takes. A process that is stopped
or waits for something that never comes does neither. One that computes for ever is ended by its longest time.
"""

from __future__ import annotations

import time

from ultragray_workers.jobs.worker.processes import Account, account_of

LEAST_CPU_S = 0.1  # of a process that gets on; waiting with a look now and then takes less
LONGEST_STEP_S = 2.0  # between two looks; what is longer, this worker itself was stopped for


class Watchdog:
    """Looks at one process now and then."""

    def __init__(self, pid: int, stall_timeout_s: float) -> None:
        """`stall_timeout_s` 0: never."""
        self._pid, self._stall_timeout_s = pid, stall_timeout_s
        self._looked_at_s = time.monotonic()
        self._at_last_sign = Account()
        self._idle_s = 0.0

    @property
    def is_stalled(self) -> bool:
        """Whether the process has not got on for the whole timeout."""
        return 0.0 < self._stall_timeout_s <= self._idle_s

    def look(self) -> float:
        """Looks at the process; the seconds since the last look, as far as this worker was there to see."""
        now_s = time.monotonic()
        passed_s = min(LONGEST_STEP_S, now_s - self._looked_at_s)
        self._looked_at_s = now_s
        account, before = account_of(self._pid), self._at_last_sign
        if (
            account.is_ready
            or account.io_bytes != before.io_bytes
            or not 0.0 <= account.cpu_s - before.cpu_s < LEAST_CPU_S  # less than before: a child has ended
        ):
            self._at_last_sign, self._idle_s = account, 0.0
        else:
            self._idle_s += passed_s
        return passed_s
